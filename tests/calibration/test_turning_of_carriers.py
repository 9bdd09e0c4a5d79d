"""The verdict says how carriers turned where that is why poses are not known: one axis, a plane, too little."""

from __future__ import annotations

import numpy as np
import pytest
from board_by_camera import problem_of
from rwhec_factors.se3 import expmap, inverse

import gtsam_rwhec as rw
from gtsam_rwhec.calibration.stages import turning_of
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.simulate.simulated_noise import random_poses

COUNT = 24
NOISE = np.repeat([2e-4, 1e-4], 3)


def calibrated(turns_deg: tuple[float, float, float], ways_m: tuple[float, float, float]) -> rw.Calibration:
    """A camera on a hand that turns and moves by these standard deviations, along axes that are askew in its frame."""
    rng = np.random.default_rng(7)
    xi = rng.normal(size=(COUNT, 6)) * np.r_[np.radians(turns_deg), ways_m]
    askew, X, Y = random_poses(3, 0.4, rng)
    turned = expmap(np.pad(xi[:, :3], ((0, 0), (0, 3))))
    turned[:, :3, 3] = xi[:, 3:]
    A = askew @ turned @ inverse(askew[None])
    B = inverse(Y[None]) @ A @ X @ expmap(NOISE * rng.standard_normal((COUNT, 6)))
    return rw.calibrate(problem_of(A, B))


@pytest.mark.parametrize(
    ("turns_deg", "ways_m", "ground", "words"),
    [
        ((0.0, 0.0, 30.0), (0.1, 0.1, 0.1), rw.Ground.NOT_UNIQUE, "motion about one axis only"),
        ((0.0, 0.0, 30.0), (0.1, 0.1, 0.0), rw.Ground.NOT_UNIQUE, "planar motion"),
        ((0.0, 0.0, 0.0), (0.1, 0.1, 0.1), rw.Ground.NOT_UNIQUE, "too little rotation"),
        ((1.0, 1.0, 1.0), (0.1, 0.1, 0.1), rw.Ground.LITTLE_ROTATION, "too little rotation"),
        ((1.0, 1.0, 30.0), (0.1, 0.1, 0.1), rw.Ground.LITTLE_ROTATION, "about one axis and"),
    ],
)
def test_the_verdict_says_how_the_carriers_turned(
    turns_deg: tuple[float, float, float], ways_m: tuple[float, float, float], ground: rw.Ground, words: str
) -> None:
    judgement = calibrated(turns_deg, ways_m).judgement
    assert judgement.grounds == (ground,)
    assert words in judgement.reason


def test_a_good_motion_is_not_accused() -> None:
    assert calibrated((15.0, 12.0, 20.0), (0.1, 0.1, 0.1)).verdict is rw.Verdict.USE


def test_the_spread_of_turns_is_that_about_the_mean_and_the_motion_along_the_axis_is_told() -> None:
    angles = np.radians([-40.0, -10.0, 20.0, 50.0])
    xi: Array = np.zeros((4, 6))
    xi[:, 2] = angles
    A = expmap(xi)
    A[:, 2, 3] = [0.0, 0.1, 0.0, 0.1]
    found = turning_of(A)
    assert found.spread_rad == pytest.approx([np.std(angles), 0.0, 0.0], abs=1e-6)
    assert (found.along_m, found.across_m) == pytest.approx((0.05, 0.0), abs=1e-9)
