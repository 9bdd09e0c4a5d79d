"""Poses of flat targets: true without noise, with covariances that cover the errors, nan without a pose."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from rendered import BARREL, FISHEYE, OMNI, PINHOLE, pose, projected
from rwhec_factors import se3

from gtsam_rwhec.cameras.camera import Camera
from gtsam_rwhec.cameras.target_poses import PlanePoses, plane_poses
from gtsam_rwhec.cameras.targets import AprilGrid, Charuco, Checkerboard, Tag, Target

CAMERAS = (PINHOLE, BARREL, FISHEYE, OMNI)
TAG = Tag("tag", "tag36h11", 0, 0.1)
BOARD = Charuco("board", "aruco_5x5_100", 6, 4, 0.03, 0.02)
TARGETS: tuple[Target, ...] = (TAG, BOARD, AprilGrid("g", "tag36h11", 2, 2, 0.04, 0.3), Checkerboard("c", 4, 3, 0.03))


def estimated(camera: Camera, target: Target, pixels: np.ndarray, corner_px: float = 0.1) -> PlanePoses:
    """Poses from N sets (N, n, 2) of all of a target's corners."""
    return plane_poses(camera, [target.corners()] * len(pixels), list(pixels), corner_px=corner_px)


def nearest(T: np.ndarray, truth: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Errors (N, 6) of the nearer candidate of (N, 2, 4, 4), and its number (N,)."""
    errors = se3.logmap((np.linalg.inv(truth) @ np.nan_to_num(T, nan=1.0)).reshape(-1, 4, 4)).reshape(-1, 2, 6)
    which = np.argmin(np.where(np.isfinite(T[:, :, 0, 0]), np.linalg.norm(errors, axis=2), np.inf), axis=1)
    return np.take_along_axis(errors, which[:, None, None], axis=1)[:, 0], which


@settings(max_examples=60, deadline=None)
@given(
    st.sampled_from(CAMERAS),
    st.sampled_from(TARGETS),
    st.tuples(st.floats(10.0, 65.0), st.floats(0.0, 360.0), st.floats(-180.0, 180.0)),
    st.tuples(st.floats(-0.3, 0.3), st.floats(-0.2, 0.2), st.floats(0.3, 1.5)),
)
def test_without_noise_the_pose_is_the_truth(
    camera: Camera, target: Target, turn: tuple[float, float, float], place: tuple[float, float, float]
) -> None:
    tilt, about, roll = np.radians(turn[0]), np.radians(turn[1]), turn[2]
    across, z = np.array(place[:2]), place[2]
    T = pose((np.degrees(tilt) * np.cos(about), np.degrees(tilt) * np.sin(about), 0.0), (*(across * z), z))
    T = T @ np.block([[pose((0.0, 0.0, roll), (0, 0, 0))[:3, :3] @ np.diag([1.0, -1.0, -1.0]), np.zeros((3, 1))],
                      [np.zeros((1, 3)), np.ones((1, 1))]])  # fmt: skip
    if (-T[:3, 2] @ T[:3, 3]) / np.linalg.norm(T[:3, 3]) < np.cos(np.radians(80.0)):
        return  # nearly from the side
    found = estimated(camera, target, projected(camera, target.corners(), T)[None])
    error, which = nearest(found.T, T)
    assert found.squared_px[0, which[0]] < 1e-10
    np.testing.assert_allclose(error[0], 0.0, atol=2e-5)
    assert found.squared_px[0, 0] <= found.squared_px[0, 1] or np.isnan(found.squared_px[0, 1])
    np.testing.assert_allclose(found.errors_px[0], 0.0, atol=1e-4)


@pytest.mark.parametrize("far", [0.3, 0.3046875, 0.5])
@pytest.mark.parametrize("tilt_deg", [0.0, 10.0, 30.0])
def test_targets_exactly_on_the_axis_have_their_true_pose(tilt_deg: float, far: float) -> None:
    for camera in CAMERAS:
        for target in TARGETS:
            T = pose((tilt_deg, 0.0, 0.0), (0.0, 0.0, far))
            found = estimated(camera, target, projected(camera, target.corners(), T)[None])
            assert found.squared_px[0, 0] < 1e-10
            if tilt_deg:
                np.testing.assert_allclose(nearest(found.T, T)[0][0], 0.0, atol=2e-5)


@pytest.mark.parametrize("camera", CAMERAS, ids=lambda camera: camera.model)
@pytest.mark.parametrize("target", [TAG, BOARD], ids=lambda target: target.name)
def test_the_covariance_covers_the_errors(camera: Camera, target: Target) -> None:
    N, sigma = 300, 0.2
    T = pose((30.0, -25.0, 40.0), (0.03, -0.02, 0.35))
    pixels = projected(camera, target.corners(), T)
    noisy = pixels + np.random.default_rng(5).normal(scale=sigma, size=(N, *pixels.shape))
    found = estimated(camera, target, noisy, corner_px=sigma)
    errors, which = nearest(found.T, T)
    covariance = found.covariance[np.arange(N), which]
    chi2 = np.einsum("ni,nij,nj->n", errors, np.linalg.inv(covariance), errors)
    assert chi2.mean() == pytest.approx(6.0, abs=4.0 * np.sqrt(12.0 / N))
    # Each of the six alone: rotations in rad, translations in m.
    share = (errors**2).mean(axis=0) / np.diagonal(covariance, axis1=1, axis2=2).mean(axis=0)
    np.testing.assert_allclose(share, 1.0, atol=4.5 * np.sqrt(2.0 / N))
    # What is left of the corners' noise tells its size.
    spare = 2 * len(pixels) - 6
    left = found.squared_px[np.arange(N), which] / sigma**2
    assert left.mean() == pytest.approx(spare, abs=4.0 * np.sqrt(2.0 * spare / N))


@pytest.mark.parametrize("camera", CAMERAS, ids=lambda camera: camera.model)
def test_the_covariance_is_the_inverse_of_numeric_information(camera: Camera) -> None:
    T, h = pose((20.0, 30.0, -50.0), (0.05, 0.02, 0.4)), 1e-6
    for target in TARGETS:
        corners = target.corners()
        J = np.empty((2 * len(corners), 6))
        for k, step in enumerate(h * np.eye(6)):  # a right perturbation, rotation first
            ahead, behind = (projected(camera, corners, T @ se3.expmap(s[None])[0]) for s in (step, -step))
            J[:, k] = ((ahead - behind) / (2 * h)).ravel()
        expected = 0.3**2 * np.linalg.inv(J.T @ J)
        found = estimated(camera, target, projected(camera, corners, T)[None], corner_px=0.3)
        _, which = nearest(found.T, T)
        scale = np.sqrt(np.outer(np.diagonal(expected), np.diagonal(expected)))
        np.testing.assert_allclose(found.covariance[0, which[0]] / scale, expected / scale, atol=1e-4)


def test_both_candidates_of_a_far_tag_are_minima_and_mirror_images() -> None:
    T = pose((25.0, 0.0, 10.0), (0.0, 0.0, 2.0))
    pixels = projected(PINHOLE, TAG.corners(), T)
    found = estimated(PINHOLE, TAG, pixels[None])
    assert np.isfinite(found.T).all()
    error, which = nearest(found.T, T)
    np.testing.assert_allclose(error[0], 0.0, atol=1e-5)
    other = found.T[0, 1 - which[0]]
    # The same tilt the other way round, some 50 degrees from the truth, and hardly worse.
    turned = np.degrees(np.arccos(0.5 * (np.trace(T[:3, :3].T @ other[:3, :3]) - 1.0)))
    assert 40.0 < turned < 60.0
    assert 1e-6 < found.squared_px[0, 1 - which[0]] < 1.0

    def cost(xi: np.ndarray) -> float:
        return float(((projected(PINHOLE, TAG.corners(), other @ se3.expmap(xi[None])[0]) - pixels) ** 2).sum())

    gradient = np.array([(cost(s) - cost(-s)) / 2e-6 for s in 1e-6 * np.eye(6)])
    sigma = np.sqrt(np.diagonal(found.covariance[0, 1 - which[0]])) / 0.1
    np.testing.assert_allclose(gradient * sigma, 0.0, atol=1e-3)


def test_candidates_are_ordered_by_reprojection_error() -> None:
    generator = np.random.default_rng(0)
    T = pose((15.0, 10.0, 0.0), (0.0, 0.0, 1.5))
    noisy = projected(PINHOLE, TAG.corners(), T) + generator.normal(scale=0.3, size=(50, 4, 2))
    found = estimated(PINHOLE, TAG, noisy)
    both = np.isfinite(found.squared_px).all(axis=1)
    assert both.sum() > 25
    assert (found.squared_px[both, 0] <= found.squared_px[both, 1]).all()
    _, which = nearest(found.T, T)
    assert 5 < which.sum() < 45  # what is left does not tell which is right
    np.testing.assert_allclose(found.reprojection_px, np.sqrt(found.squared_px / 4))
    np.testing.assert_allclose((found.errors_px**2).sum(axis=(1, 2)), found.squared_px[:, 0], rtol=1e-9)
    k = int(np.flatnonzero(both)[0])
    predicted = projected(PINHOLE, TAG.corners(), found.T[k, 0])
    np.testing.assert_allclose(found.errors_px[k], noisy[k] - predicted, atol=1e-9)


def test_many_targets_together_give_what_each_gives_alone() -> None:
    generator = np.random.default_rng(1)
    points, pixels = [], []
    for target in TARGETS * 3:
        some = np.sort(generator.permutation(len(target.corners()))[: max(4, len(target.corners()) - 3)])
        T = pose((*generator.uniform(-40, 40, 2), 0.0), (*generator.uniform(-0.1, 0.1, 2), 0.5))
        points.append(target.corners()[some])
        pixels.append(projected(BARREL, points[-1], T) + generator.normal(scale=0.1, size=(len(some), 2)))
    together = plane_poses(BARREL, points, pixels, corner_px=0.1)
    assert together.errors_px.shape == (12, max(map(len, points)), 2)
    for i, (p, u) in enumerate(zip(points, pixels, strict=True)):
        alone = plane_poses(BARREL, [p], [u], corner_px=0.1)
        np.testing.assert_allclose(together.T[i], alone.T[0], atol=1e-5)
        np.testing.assert_allclose(together.squared_px[i], alone.squared_px[0], rtol=1e-6)
        assert np.isfinite(together.errors_px[i]).all(axis=1).sum() == len(p)


BAD = {
    "one point": np.full((4, 2), 100.0),
    "a line": np.array([[10.0, 10.0], [20.0, 20.0], [30.0, 30.0], [40.0, 40.0]]),
    "not seen": np.full((4, 2), np.nan),
    "one not seen": np.array([[10.0, 10.0], [40.0, 10.0], [np.nan, np.nan], [10.0, 40.0]]),
    "mirrored": np.array([[40.0, 10.0], [10.0, 10.0], [10.0, 40.0], [40.0, 40.0]]),
    "crossed": np.array([[10.0, 10.0], [40.0, 40.0], [40.0, 10.0], [10.0, 40.0]]),
    "endless": np.array([[10.0, 10.0], [np.inf, 10.0], [40.0, 40.0], [10.0, 40.0]]),
    "huge": 1e12 * np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]]),
}


@pytest.mark.parametrize("camera", CAMERAS, ids=lambda camera: camera.model)
@pytest.mark.parametrize("bad", BAD)
def test_corners_of_no_plane_have_no_pose_and_do_not_change_the_others(bad: str, camera: Camera) -> None:
    good = projected(camera, TAG.corners(), pose((20.0, 10.0, 0.0), (0.0, 0.0, 0.4)))
    found = estimated(camera, TAG, np.array([good, BAD[bad], good]))
    assert np.isfinite(found.squared_px[[0, 2], 0]).all()
    np.testing.assert_allclose(found.T[0], found.T[2])
    from_behind = (found.T[1, :, :3, 2] * found.T[1, :, :3, 3]).sum(axis=1) > 0.0
    fits = found.reprojection_px[1] < 2.0
    if bad in ("mirrored", "crossed", "huge", "a line"):  # if anything comes out, it fits badly or looks away
        assert not (fits & ~from_behind).any()
    else:
        assert np.isnan(found.squared_px[1]).all()
    R = found.T[1, :, :3, :3]
    finite = np.isfinite(found.squared_px[1])
    np.testing.assert_allclose(
        R[finite] @ np.swapaxes(R[finite], 1, 2), np.eye(3)[None].repeat(finite.sum(), 0), atol=1e-8
    )


def test_points_on_a_line_of_the_target_have_no_pose() -> None:
    points = BOARD.corners()[:5]
    T = pose((20.0, 10.0, 0.0), (0.0, 0.0, 0.4))
    found = plane_poses(PINHOLE, [points], [projected(PINHOLE, points, T)], corner_px=0.1)
    assert np.isnan(found.squared_px).all()


def test_no_targets_give_no_poses() -> None:
    found = plane_poses(PINHOLE, [], [], corner_px=0.1)
    assert found.T.shape == (0, 2, 4, 4)
    assert found.covariance.shape == (0, 2, 6, 6)
