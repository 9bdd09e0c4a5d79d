"""Time offsets from turning alone, before any extrinsics are known."""

from __future__ import annotations

import numpy as np
import pytest
from rwhec_factors import se3

import gtsam_rwhec as rw
from gtsam_rwhec.cleaning import coarse_time_offset
from gtsam_rwhec.simulate import Noise, perturb
from gtsam_rwhec.simulate.transforms import random_poses
from gtsam_rwhec.trajectories import Trajectory

X, Y = random_poses(2, 1.0, np.random.default_rng(0))
NOISE = Noise(0.005, 0.5 / np.radians(0.5) ** 2)


def path(t: np.ndarray) -> np.ndarray:
    xi = np.column_stack(
        [
            0.7 * np.sin(1.1 * t) + 0.2 * np.sin(3.1 * t),
            0.6 * np.cos(0.83 * t),
            0.8 * np.sin(0.61 * t + 1.0),
            np.sin(0.4 * t),
            np.cos(0.7 * t),
            0.2 * np.sin(t),
        ]
    )
    return se3.expmap(xi)


def carrier(seconds: float = 30.0) -> Trajectory:
    stamps = np.arange(int(100 * seconds)) * 10**7
    return Trajectory.of(stamps, path(stamps * 1e-9), "/hand")


def track(offset_s: float, seed: int = 0, count: int = 400, bad: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    stamps = 2 * 10**9 + np.arange(count) * 66_666_667
    B = perturb(np.linalg.inv(Y) @ path(stamps * 1e-9 + offset_s) @ X, NOISE, seed)
    generator = np.random.default_rng(seed)
    wrong = generator.random(count) < bad
    B[wrong] = random_poses(int(wrong.sum()), 1.0, generator)
    return stamps, B


@pytest.mark.parametrize("offset", [-0.31, 0.0, 0.035, 0.8])
def test_offsets_are_found(offset: float) -> None:
    found = coarse_time_offset(carrier(), [track(offset)])
    assert found.offset_s == pytest.approx(offset, abs=4.0 * found.sigma_s + 1e-4)
    assert found.sigma_s < 0.003
    assert found.angle_rms_rad == pytest.approx(np.radians(0.5) * np.sqrt(2.0), rel=0.3)


def test_the_standard_deviation_holds() -> None:
    scores = []
    for seed in range(15):
        found = coarse_time_offset(carrier(), [track(0.035, seed, 150)], search_s=0.2)
        scores.append((found.offset_s - 0.035) / found.sigma_s)
    assert np.sqrt(np.mean(np.square(scores))) < 1.5  # overlapping intervals make it a little too wide
    assert np.sqrt(np.mean(np.square(scores))) > 0.2


def test_wrong_detections_do_not_move_it() -> None:
    found = coarse_time_offset(carrier(), [track(0.1, bad=0.2)])
    assert found.offset_s == pytest.approx(0.1, abs=0.003)


def test_tracks_of_several_targets_add_up() -> None:
    one = coarse_time_offset(carrier(), [track(0.05, 1)])
    two = coarse_time_offset(carrier(), [track(0.05, 1), track(0.05, 2)])
    assert two.sigma_s < 0.85 * one.sigma_s


@pytest.mark.parametrize(
    ("road", "words"),
    [
        (lambda t: se3.expmap(t[:, None] * np.array([0, 0, 0.5, 0.1, 0, 0])), "."),  # turns evenly
        (lambda t: se3.expmap(t[:, None] * np.array([0, 0, 0, 0.1, 0, 0])), "."),  # does not turn
        (
            lambda t: se3.expmap(np.sin(2 * np.pi * t)[:, None] * np.array([0.5, 0.2, 0.1, 0, 0, 0])),
            "repeats itself",
        ),
    ],
)
def test_motions_that_do_not_tell_are_refused(road: object, words: str) -> None:
    stamps = np.arange(3000) * 10**7
    trajectory = Trajectory.of(stamps, road(stamps * 1e-9))
    seen = 2 * 10**9 + np.arange(300) * 66_666_667
    B = perturb(np.linalg.inv(Y) @ road(seen * 1e-9) @ X, NOISE, 0)
    with pytest.raises(rw.errors.StampError, match=words):
        coarse_time_offset(trajectory, [(seen, B)], search_s=1.7)


def test_too_few() -> None:
    with pytest.raises(rw.errors.StampError, match="at least ten"):
        coarse_time_offset(carrier(), [track(0.0, count=12)])


def test_other_clocks() -> None:
    stamps, B = track(0.0)
    with pytest.raises(rw.errors.StampError, match="another clock"):
        coarse_time_offset(carrier(), [(stamps + 10**15, B)])
