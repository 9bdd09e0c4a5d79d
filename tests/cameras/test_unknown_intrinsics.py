"""Intrinsics from views of boards alone: of every lens, with no more coefficients than the corners ask for."""

from __future__ import annotations

import numpy as np
import pytest
from rendered import pose, projected
from rwhec_factors import se3

from gtsam_rwhec.cameras.camera import Camera
from gtsam_rwhec.cameras.targets import Checkerboard
from gtsam_rwhec.cameras.unknown_intrinsics import Lens, different_views, estimated_intrinsics, fitted_to_planes
from gtsam_rwhec.errors import CameraError
from gtsam_rwhec.geometry.poses import Array

SIZE = (640, 480)
BOARD = np.stack([*np.meshgrid(0.04 * np.arange(8) - 0.14, 0.04 * np.arange(6) - 0.1), np.zeros((6, 8))], -1)
BOARD = BOARD.reshape(-1, 3)
NOISE_PX = 0.1


def camera(model: str, f: float, D: tuple[float, ...]) -> Camera:
    return Camera.of(*SIZE, model, [[f, 0.0, 322.0], [0.0, f - 2.0, 238.0], [0.0, 0.0, 1.0]], D, "test")


RADTAN = camera("radtan", 520.0, (-0.28, 0.09, 8e-4, -5e-4))
PINHOLE = camera("pinhole", 520.0, ())
FISHEYE = camera("equidistant", 230.0, (-0.02, 6e-3, -4e-3, 8e-4))


def views(given: Camera, number: int, tilt_deg: float, seed: int = 0) -> tuple[list[Array], list[Array]]:
    """Corners on the board, and where they are seen, with noise, by a camera before which the board is tilted."""
    rng = np.random.default_rng(seed)
    points: list[Array] = []
    pixels: list[Array] = []
    while len(points) < number:
        axis = rng.normal(size=3) * [1.0, 1.0, 0.3]
        turn = axis / np.linalg.norm(axis) * np.radians(rng.uniform(0.3, 1.0) * tilt_deg)
        T = se3.expmap(np.concatenate([turn, np.zeros(3)])[None])[0]
        T[:3, 3] = [rng.uniform(-0.15, 0.15), rng.uniform(-0.1, 0.1), rng.uniform(0.35, 0.7) * given.K[0, 0] / 520.0]
        u = given.project(BOARD @ T[:3, :3].T + T[:3, 3]) + NOISE_PX * rng.normal(size=(len(BOARD), 2))
        seen = np.isfinite(u).all(axis=1) & given.inside(u)
        if seen.sum() >= 12:
            points.append(BOARD[seen])
            pixels.append(u[seen])
    return points, pixels


@pytest.mark.parametrize(
    ("given", "lens", "model"),
    [
        (RADTAN, "any", "radtan"),
        (PINHOLE, "any", "pinhole"),
        (FISHEYE, "any", "equidistant"),
        (RADTAN, "radtan", "radtan"),
    ],
    ids=["radtan", "pinhole", "fisheye", "radtan stated"],
)
def test_the_lens_that_made_the_views_is_found(given: Camera, lens: Lens, model: str) -> None:
    points, pixels = views(given, 20, 40.0)
    seen = np.concatenate(pixels)
    found = estimated_intrinsics(points, pixels, SIZE, lens)
    assert found.camera.model == model
    assert (found.views, found.camera.width, found.camera.height) == (20, *SIZE)
    K, true = found.camera.K, given.K
    off = np.array([K[0, 0], K[1, 1], K[0, 2], K[1, 2]]) - [true[0, 0], true[1, 1], true[0, 2], true[1, 2]]
    assert (np.abs(off) < 4.5 * found.sigma).all()
    assert found.sigma.max() < 0.01 * true[0, 0]
    assert found.rms_px == pytest.approx(NOISE_PX * np.sqrt(2.0), rel=0.1)
    # where there were corners, pixels of the true camera's rays are those of the estimated one's
    assert np.linalg.norm(found.camera.pixels(given.undistort(seen)) - seen, axis=-1).max() < 3.0


@pytest.mark.parametrize("number", [0, 1, 2])
def test_too_few_views_are_refused(number: int) -> None:
    with pytest.raises(CameraError, match=rf"cannot be estimated from {number} views? of a flat target with 6 corners"):
        estimated_intrinsics(*views(RADTAN, number, 40.0), SIZE)


def test_views_of_four_corners_do_not_count() -> None:
    points, pixels = views(PINHOLE, 10, 40.0)
    with pytest.raises(CameraError, match="from 0 views"):
        estimated_intrinsics([p[:4] for p in points], [u[:4] for u in pixels], SIZE)


@pytest.mark.parametrize("lens", ["pinhole", "radtan"])
def test_frontal_views_determine_no_focal_length(lens: Lens) -> None:
    with pytest.raises(CameraError, match=r"its 12 views of flat targets.*tilt (them|the targets) by 20 to 50 degrees"):
        estimated_intrinsics(*views(PINHOLE, 12, 0.5), SIZE, lens)


def test_a_misread_view_does_not_count() -> None:
    points, pixels = views(RADTAN, 12, 40.0)
    pixels[4] = pixels[4] * [1.0, 0.8] + [0.0, 60.0] + 12.0 * np.sin(pixels[4] / 20.0)
    found = estimated_intrinsics(points, pixels, SIZE)
    assert found.views == 11
    assert found.camera.K[0, 0] == pytest.approx(520.0, abs=4.0)


def test_of_many_views_the_different_ones_are_taken() -> None:
    points, pixels = views(PINHOLE, 12, 40.0)
    at_rest = [(points[0], pixels[0] + 1e-3 * i) for i in range(60)]
    others = list(zip(points[1:], pixels[1:], strict=True))
    chosen = different_views([*at_rest, *others], 12)
    assert sum(any(u is other for _, other in others) for _, u in chosen) == 11
    assert different_views(others, 12) == others


LENS = Camera.of(
    640,
    480,
    "plumb_bob",
    [[520.0, 0.0, 322.0], [0.0, 522.0, 231.0], [0.0, 0.0, 1.0]],
    (-0.2, 0.05, 8e-4, -5e-4),
    "test",
)
CORNERS = Checkerboard("board", 7, 5, 0.03).corners()
POSES = [pose((20.0 * np.cos(a), 25.0 * np.sin(a), 40.0 * a), (0.03 * a - 0.1, 0.02, 0.4)) for a in range(7)]
PIXELS = [projected(LENS, CORNERS, T) for T in POSES]


@pytest.mark.parametrize("K", [None, np.array([[900.0, 0.0, 250.0], [0.0, 900.0, 300.0], [0.0, 0.0, 1.0]])])
def test_exact_views_give_the_camera_and_its_poses(K: np.ndarray | None) -> None:
    found = fitted_to_planes([CORNERS] * 7, PIXELS, (640, 480), "all", K)
    assert found is not None
    assert found.rms_px < 1e-3
    assert pytest.approx(LENS.K, abs=0.1) == found.K
    assert pytest.approx(LENS.D, abs=2e-3) == found.D
    assert pytest.approx(np.array(POSES), abs=1e-3) == found.T


def test_what_is_not_estimated_is_zero() -> None:
    radial, none = (fitted_to_planes([CORNERS] * 7, PIXELS, (640, 480), kind) for kind in ("radial", "none"))  # type: ignore[arg-type]
    assert radial is not None
    assert none is not None
    assert radial.D[0] == pytest.approx(-0.2, abs=0.02)
    assert not radial.D[2:].any()
    assert not none.D.any()
    assert none.rms_px > 3.0 * radial.rms_px


def test_one_point_is_no_view() -> None:
    assert fitted_to_planes([CORNERS[:1]], [PIXELS[0][:1]], (640, 480), "none") is None
