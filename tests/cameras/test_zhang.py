"""Intrinsics from views of planes, from nothing and from far away."""

from __future__ import annotations

import numpy as np
import pytest
from rendered import pose, projected

from gtsam_rwhec.cameras.camera import Camera
from gtsam_rwhec.cameras.targets import Checkerboard
from gtsam_rwhec.cameras.unknown_intrinsics import fitted_to_planes

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
