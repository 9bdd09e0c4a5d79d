"""Unified (omnidirectional) lenses in refinement from corners: xi is a parameter."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from rwhec_factors import se3
from scipy.stats import chi2
from simulated_cells import cell

import gtsam_rwhec as rw
from gtsam_rwhec.cameras.camera import Camera

#: 166 degrees from corner to corner.
LENS = Camera.of(
    1920,
    1080,
    "unified",
    [[1300.0, 0.0, 955.0], [0.0, 1305.0, 545.0], [0.0, 0.0, 1.0]],
    (0.95, -0.1, 0.02, 1e-3, -5e-4),
    "cell",
)


def off(camera: Camera, pixels: NDArray[np.float64]) -> float:
    """How far a camera's pixels of the true rays are off, pixels."""
    return float(np.sqrt(((camera.pixels(LENS.undistort(pixels)) - pixels) ** 2).mean()))


def test_xi_is_refined_with_everything_else() -> None:
    given = cell(21, images=20, camera=LENS, stated="calibration", carrier=(1e-3, 5e-4))
    X, Y = given.near(np.random.default_rng(9))
    result = rw.refine_corners(given.observations, X, Y, rw.CornerOptions(stated="calibration"))
    intrinsics = result.intrinsics["cam_0"]
    assert intrinsics.names == ("fx/(1+xi)", "fy/(1+xi)", "cx", "cy", "xi", "k1", "k2", "p1", "p2")
    errors, names = [], []
    for name, T in (given.X | given.Y).items():
        errors.append(se3.logmap((se3.inverse((result.X | result.Y)[name].matrix()) @ T)[None])[0])
        names.append(name)
    for name in given.Y:
        errors.append(LENS.parameters - result.intrinsics[name].camera.parameters)
        names.append(f"intrinsics:{name}")
    error = np.concatenate(errors)
    assert error @ np.linalg.solve(result.covariance(*names), error) < chi2.ppf(0.999, len(error))
    pixels = given.observations.views["board", "cam_0"].pixels.reshape(-1, 2)
    before, after = (off(camera, pixels) for camera in (given.observations.cameras["cam_0"], intrinsics.camera))
    assert after < 0.7 * before


def test_an_unknown_unified_lens_is_found_from_corners() -> None:
    given = cell(2, images=20, cameras=1, camera=LENS)
    K = np.array([[1000.0, 0.0, 100.0], [0.0, 1000.0, 100.0], [0.0, 0.0, 1.0]])
    nothing = {"cam_0": Camera(1920, 1080, "unified", K, np.array([0.3, 0.0, 0.0, 0.0, 0.0]))}
    options = rw.CornerOptions(stated="unknown", carrier_noise="exact")
    found = rw.calibrate_corners(replace(given.observations, cameras=nothing), options).refined
    pixels = given.observations.views["board", "cam_0"].pixels.reshape(-1, 2)
    assert off(found.intrinsics["cam_0"].camera, pixels) < 1.0
    for name, T in (given.X | given.Y).items():
        xi = se3.logmap((se3.inverse((found.X | found.Y)[name].matrix()) @ T)[None])[0]
        assert xi @ np.linalg.solve(found.covariance(name), xi) < chi2.ppf(0.999, 6)
