"""Tags' corners from their edges against the true corners: blurred, small, slanted, half covered, through any lens."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from rendered import BARREL, FISHEYE, PINHOLE, pose, printed, projected, render

from gtsam_rwhec.cameras.camera import Camera
from gtsam_rwhec.cameras.targets import Tag
from gtsam_rwhec.detect.tag_edges import RefinedCorners, refine_corners

TAG = Tag("tag", "tag36h11", 7, 0.1)
PICTURE = printed(TAG)
MODULES = 8
COUNT = 10


def views(camera: Camera, far: float, *, slant_deg: float = 40.0, **how: float) -> tuple[list[np.ndarray], np.ndarray]:
    """Pictures of the tag in random turns, and its corners (n, 4, 2)."""
    generator = np.random.default_rng(0)
    images, corners = [], []
    for seed in range(COUNT):
        T = pose(
            (*generator.uniform(-slant_deg, slant_deg, 2), generator.uniform(-180, 180)),
            (*(far * generator.uniform(-0.12, 0.12, 2)), far),
        )
        images.append(render(camera, [(PICTURE, T)], seed=seed, **how))  # type: ignore[arg-type]
        corners.append(projected(camera, TAG.corners(), T))
    return images, np.array(corners)


def refined(images: list[np.ndarray], start: np.ndarray, camera: Camera = PINHOLE) -> RefinedCorners:
    return refine_corners(images, np.arange(len(images)), start, camera, MODULES)


def disturbed(corners: np.ndarray, by_px: float = 0.9) -> np.ndarray:
    """Corners as a detector finds them, right to about a pixel."""
    return corners + np.random.default_rng(1).uniform(-by_px, by_px, corners.shape)


def outward(corners: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """How far the corners are too far outside, (n, 4)."""
    off = truth - truth.mean(axis=1, keepdims=True)
    return ((corners - truth) * off / np.linalg.norm(off, axis=2, keepdims=True)).sum(axis=2)


@pytest.mark.parametrize("gamma", [0.45, 0.7, 1.2])
@pytest.mark.parametrize("blur_px", [0.6, 1.2])
def test_gamma_does_not_move_corners(gamma: float, blur_px: float) -> None:
    # Blur is of light, and a power of it has its edges elsewhere: by 0.3 pixels with 0.45.
    images, truth = views(PINHOLE, 0.25, blur_px=blur_px, noise=0.0)
    powers = [np.rint(255.0 * (image / 255.0) ** gamma).astype(np.uint8) for image in images]
    found = refined(powers, disturbed(truth))
    assert abs(outward(found.corners_px, truth).mean()) < 0.05
    assert np.sqrt(((found.corners_px - truth) ** 2).mean()) < 0.04


@pytest.mark.parametrize("blur_px", [0.5, 1.0, 1.5, 2.0])
def test_blur_does_not_move_corners_as_it_does_for_corner_detectors(blur_px: float) -> None:
    images, truth = views(PINHOLE, 0.35, slant_deg=25.0, blur_px=blur_px)
    start = disturbed(truth)
    found = refined(images, start)
    assert abs(outward(found.corners_px, truth).mean()) < 0.02
    assert np.sqrt(((found.corners_px - truth) ** 2).mean()) < 0.03
    criteria = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_COUNT, 30, 1e-3)
    theirs = np.array(
        [
            cv2.cornerSubPix(image, corners.astype(np.float32)[:, None].copy(), (3, 3), (-1, -1), criteria)[:, 0]
            for image, corners in zip(images, start, strict=True)
        ]
    )
    assert outward(theirs, truth).mean() < -0.1


@pytest.mark.parametrize("blur_px", [0.5, 1.0])
@pytest.mark.parametrize(("camera", "far"), [(BARREL, 0.33), (FISHEYE, 0.2)], ids=["barrel", "fisheye"])
def test_through_lenses_whose_pictures_of_edges_are_bent(camera: Camera, far: float, blur_px: float) -> None:
    images, truth = views(camera, far, blur_px=blur_px)
    found = refined(images, disturbed(truth), camera)
    assert abs(outward(found.corners_px, truth).mean()) < 0.015
    assert np.sqrt(((found.corners_px - truth) ** 2).mean()) < 0.03
    # A straight line between corners is not where the edge is.
    without = refined(images, disturbed(truth), Camera.of(320, 240, "", camera.K, (), "test"))
    assert np.sqrt(((without.corners_px - truth) ** 2).mean()) > 0.06


def test_small_tags() -> None:
    images, truth = views(PINHOLE, 1.2, blur_px=0.6)  # 25 pixels: a module is three
    found = refined(images, disturbed(truth))
    assert np.linalg.norm(np.diff(truth, axis=1), axis=2).mean() < 27.0
    assert abs(outward(found.corners_px, truth).mean()) < 0.05
    assert np.sqrt(((found.corners_px - truth) ** 2).mean()) < 0.05


@pytest.mark.parametrize("blur_px", [0.7, 1.5, 2.5, 4.0])
def test_the_blur_is_measured(blur_px: float) -> None:
    images, truth = views(PINHOLE, 0.2, blur_px=blur_px)
    found = refined(images, disturbed(truth))
    own = np.sqrt(1.0 / 12.0 + 1.0 / 6.0 + 0.05)  # a pixel's, of interpolating between them, and the picture's
    np.testing.assert_allclose(found.blur_px, np.hypot(blur_px, own), rtol=0.12)


def test_motion_blur_is_measured_on_the_two_blurred_sides() -> None:
    T = pose((0.0, 0.0, 0.0), (0.0, 0.0, 0.3))
    image = render(PINHOLE, [(PICTURE, T)])
    moved = cv2.blur(image, (9, 1))
    truth = projected(PINHOLE, TAG.corners(), T)[None]
    still, smeared = refined([image], disturbed(truth)), refined([moved], disturbed(truth))
    assert still.blur_px[0] < 1.1
    assert smeared.blur_px[0] == pytest.approx(np.hypot(still.blur_px[0], 9 / np.sqrt(12)), rel=0.15)
    np.testing.assert_allclose(smeared.corners_px, truth, atol=0.12)  # symmetric: it stays where it is


def test_shade_across_the_tag() -> None:
    images, truth = views(PINHOLE, 0.4)
    shade = np.linspace(0.3, 1.1, 320)[None] * np.linspace(1.0, 0.7, 240)[:, None]
    shaded = [np.clip(np.rint(image * shade), 0, 255).astype(np.uint8) for image in images]
    found = refined(shaded, disturbed(truth))
    assert np.sqrt(((found.corners_px - truth) ** 2).mean()) < 0.05


def test_a_finger_on_an_edge() -> None:
    T = pose((10.0, 20.0, 8.0), (0.0, 0.0, 0.3))
    truth = projected(PINHOLE, TAG.corners(), T)
    middle = np.rint(0.5 * (truth[0] + truth[1])).astype(int)
    covered = np.s_[middle[1] - 12 : middle[1] + 12, middle[0] - 14 : middle[0] + 14]
    image = render(PINHOLE, [(PICTURE, T)], covered=covered)
    assert (image[covered][3:-3, 3:-3] > 95).all()
    found = refined([image], disturbed(truth[None]))
    np.testing.assert_allclose(found.corners_px[0], truth, atol=0.12)


def test_a_side_without_an_edge_has_no_corners() -> None:
    images, truth = views(PINHOLE, 0.4)
    blank = render(PINHOLE, [])
    noise = np.random.default_rng(0).integers(0, 256, (240, 320)).astype(np.uint8)
    # An edge that goes on where a side should be: its whole upper side is under something as black as the border.
    half = images[0].copy()
    half[: int(truth[0].mean(axis=0)[1])] = 20
    negative = 255 - images[0]
    found = refined([blank, noise, half, negative, images[0]], np.repeat(truth[:1], 5, axis=0))
    assert np.isnan(found.corners_px[:4]).all(axis=(1, 2)).tolist() == [True] * 4
    assert np.isnan(found.blur_px[:4]).all()
    np.testing.assert_allclose(found.corners_px[4], truth[0], atol=0.1)


def test_a_missing_tag_does_not_change_the_others() -> None:
    images, truth = views(PINHOLE, 0.4)
    alone = refined(images[:1], disturbed(truth[:1]))
    bad = np.array([np.full((4, 2), np.nan), np.full((4, 2), 50.0), np.full((4, 2), 1e9), -disturbed(truth[:1])[0]])
    together = refine_corners(
        [images[1], images[0]], np.array([0, 0, 0, 0, 1]), np.concatenate([bad, disturbed(truth[:1])]), PINHOLE, MODULES
    )
    np.testing.assert_allclose(together.corners_px[4], alone.corners_px[0], atol=1e-9)
    assert np.isnan(together.corners_px[:4]).all()


def test_a_start_too_far_away_is_not_trusted() -> None:
    images, truth = views(PINHOLE, 0.4)
    found = refined(images[:1], truth[:1] + 25.0)
    assert np.isnan(found.corners_px).all() or np.abs(found.corners_px - truth[:1]).max() > 1.0


def test_at_the_images_rim() -> None:
    T = pose((0.0, 0.0, 0.0), (-0.125, 0.0, 0.35))  # its white margin is cut
    image, truth = render(PINHOLE, [(PICTURE, T)]), projected(PINHOLE, TAG.corners(), T)
    assert 3.0 < truth[:, 0].min() < 12.0
    found = refined([image], disturbed(truth[None], 0.5))
    np.testing.assert_allclose(found.corners_px[0], truth, atol=0.12)


def test_no_tags_give_no_corners() -> None:
    found = refine_corners(
        [np.zeros((240, 320), np.uint8)], np.zeros(0, dtype=int), np.zeros((0, 4, 2)), PINHOLE, MODULES
    )
    assert found.corners_px.shape == (0, 4, 2)
    assert found.blur_px.shape == (0,)
