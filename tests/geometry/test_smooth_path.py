"""Smooth paths: poses and velocities with less noise than what was logged, and no lack of fit."""

from __future__ import annotations

import numpy as np
import pytest
from rwhec_factors import se3

import gtsam_rwhec as rw
from gtsam_rwhec.geometry import Trajectory
from gtsam_rwhec.geometry.trajectory import SmoothPath

STAMPS = np.arange(1000) * 10_000_000
INSIDE = np.arange(500_000_000, 9_000_000_000, 13_000_001)


def road(t: np.ndarray, hertz: float = 0.4) -> np.ndarray:
    w = 2.0 * np.pi * hertz
    return se3.expmap(np.column_stack([np.sin(w * t), np.cos(0.7 * w * t), 0.5 * np.sin(0.4 * w * t + 1.0)] * 2))


def velocity(t: np.ndarray, hertz: float = 0.4) -> np.ndarray:
    h = 1e-5
    return se3.logmap(se3.inverse(road(t - h, hertz)) @ road(t + h, hertz)) / (2.0 * h)


def test_noise_is_averaged_and_its_variance_is_known() -> None:
    noise = se3.expmap(0.003 * np.random.default_rng(0).normal(size=(1000, 6)))
    smooth = SmoothPath.of(Trajectory.of(STAMPS, road(STAMPS * 1e-9) @ noise))
    poses, found, variance = smooth.at(INSIDE)
    assert np.sqrt(smooth.scatter).mean() == pytest.approx(0.003, rel=0.1)
    off = se3.logmap(se3.inverse(road(INSIDE * 1e-9)) @ poses)
    assert np.sqrt(np.mean(off**2)) < 0.6 * 0.003
    ratio = np.mean((found - velocity(INSIDE * 1e-9)) ** 2 / variance)
    assert 0.4 < ratio < 2.5


@pytest.mark.parametrize("hertz", [0.4, 3.0])
def test_exact_paths_stay_exact(hertz: float) -> None:
    smooth = SmoothPath.of(Trajectory.of(STAMPS, road(STAMPS * 1e-9, hertz)))
    poses, found, _ = smooth.at(INSIDE)
    t = INSIDE * 1e-9
    assert np.abs(se3.logmap(se3.inverse(road(t, hertz)) @ poses)).max() < 2e-3
    assert np.abs(found - velocity(t, hertz)).max() < 0.01 * np.abs(velocity(t, hertz)).max()


def test_a_gap_does_not_reach_into_what_is_beside_it() -> None:
    kept = (STAMPS < 4_000_000_000) | (STAMPS > 6_000_000_000)
    smooth = SmoothPath.of(Trajectory.of(STAMPS[kept], road(STAMPS[kept] * 1e-9)))
    beside = np.array([3_900_000_000, 6_100_000_000])
    off = se3.logmap(se3.inverse(road(beside * 1e-9)) @ smooth.at(beside)[0])
    assert np.abs(off).max() < 1e-3


def test_too_few_poses() -> None:
    with pytest.raises(rw.errors.StampError, match="/hand: 7 poses are too few"):
        SmoothPath.of(Trajectory.of(STAMPS[:7], road(STAMPS[:7] * 1e-9), "/hand"))
