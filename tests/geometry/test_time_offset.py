"""Time offsets from turning alone, before any extrinsics are known."""

from __future__ import annotations

import numpy as np
import pytest
from rwhec_factors import se3
from turning_tracks import NOISE, X, Y, carrier, path, track

import gtsam_rwhec as rw
from gtsam_rwhec.geometry import Trajectory, estimate_time_offset
from gtsam_rwhec.simulate import perturb


@pytest.mark.parametrize("offset", [-0.31, 0.0, 0.035, 0.8])
def test_offsets_are_found(offset: float) -> None:
    found = estimate_time_offset(carrier(), [track(offset)])
    assert found.offset_s == pytest.approx(offset, abs=4.0 * found.sigma_s + 1e-4)
    assert found.sigma_s < 0.003
    assert found.rms_rad == pytest.approx(np.radians(0.5), rel=0.1)
    assert found.measurements > 350


def test_wrong_detections_do_not_move_it() -> None:
    found = estimate_time_offset(carrier(), [track(0.1, bad=0.2)], search_s=0.3)
    assert found.offset_s == pytest.approx(0.1, abs=0.003)


def test_tracks_of_several_targets_add_up() -> None:
    one = estimate_time_offset(carrier(), [track(0.05, 1)], search_s=0.2)
    two = estimate_time_offset(carrier(), [track(0.05, 1), track(0.05, 2)], search_s=0.2)
    assert two.sigma_s < 0.85 * one.sigma_s


@pytest.mark.parametrize(
    ("road", "words"),
    [
        (lambda t: se3.expmap(t[:, None] * np.array([0, 0, 0.5, 0.1, 0, 0])), "."),  # turns evenly
        (lambda t: se3.expmap(t[:, None] * np.array([0, 0, 0, 0.1, 0, 0])), "."),  # does not turn
        (lambda t: se3.expmap(np.sin(2 * np.pi * t)[:, None] * np.array([0.5, 0.2, 0.1, 0, 0, 0])), "repeats itself"),
    ],
)
def test_motions_that_do_not_tell_are_refused(road: object, words: str) -> None:
    stamps = np.arange(3000) * 10**7
    trajectory = Trajectory.of(stamps, road(stamps * 1e-9))
    seen = 2 * 10**9 + np.arange(300) * 66_666_667
    B = perturb(np.linalg.inv(Y) @ road(seen * 1e-9) @ X, NOISE, 0)
    with pytest.raises(rw.errors.StampError, match=words):
        estimate_time_offset(trajectory, [(seen, B)], search_s=1.7)


def test_too_few() -> None:
    with pytest.raises(rw.errors.StampError, match="at least ten"):
        estimate_time_offset(carrier(), [track(0.0, count=12)])


def test_other_clocks() -> None:
    stamps, B = track(0.0)
    with pytest.raises(rw.errors.StampError, match="another clock"):
        estimate_time_offset(carrier(), [(stamps + 10**15, B)])


def test_stamps_that_go_back() -> None:
    stamps, B = track(0.0)
    stamps[100:] -= 10**9
    with pytest.raises(rw.errors.StampError, match=r"cam_0, track 0: stamp 100 \(.* is before the stamp ahead of it"):
        estimate_time_offset(carrier(), [(stamps, B)], where="cam_0")


def stop_and_go(t: np.ndarray) -> np.ndarray:
    """The path, moved along for three of each fifteen seconds."""
    moved = np.clip(np.mod(t, 15.0) - 6.0, 0.0, 3.0)
    smooth = moved - np.sin(2.0 * np.pi * moved / 3.0) * 1.5 / np.pi
    return path(3.0 * np.floor(t / 15.0) + smooth)


def standstill(moves: bool, seed: int) -> tuple[Trajectory, tuple[np.ndarray, np.ndarray]]:
    """A minute at a camera's rate, most of it at standstill; errors of B last for a second, and A has noise."""
    generator = np.random.default_rng(seed)
    road = stop_and_go if moves else (lambda t: stop_and_go(0.0 * t))
    stamps = np.arange(1800) * 33_333_333
    noise = se3.expmap(generator.normal(size=(1800, 6)) * 2e-4)
    seen = stamps[30:-30] + 7_000_000
    lasting = np.empty((len(seen), 6))
    lasting[0] = generator.normal(size=6)
    keeps = np.exp(-0.033)
    for i, new in enumerate(generator.normal(size=(len(seen) - 1, 6)) * np.sqrt(1.0 - keeps**2), start=1):
        lasting[i] = keeps * lasting[i - 1] + new
    errors = se3.expmap(0.003 * lasting + 0.001 * generator.normal(size=lasting.shape))
    B = np.linalg.inv(Y) @ road(seen * 1e-9 + 0.001) @ X @ errors
    return Trajectory.of(stamps, road(stamps * 1e-9) @ noise, "/hand"), (seen, B)


def test_standstill_is_no_evidence() -> None:
    """Turning rates of noise put the offset at -9.3 +- 0.1 ms where it was about 1 ms."""
    scores = []
    for seed in range(2):
        road, seen = standstill(True, seed)
        found = estimate_time_offset(road, [seen], search_s=0.2)
        assert found.sigma_s < 0.002
        scores.append((found.offset_s - 0.001) / found.sigma_s)
    assert np.abs(scores).max() < 3.0
    road, seen = standstill(False, 0)
    with pytest.raises(rw.errors.StampError, match="stood still or hardly turned"):
        estimate_time_offset(road, [seen], search_s=0.2)


@pytest.mark.campaign
def test_standstill_hundred_times() -> None:
    inside = []
    for seed in range(100):
        road, seen = standstill(True, seed)
        found = estimate_time_offset(road, [seen], search_s=0.2)
        inside.append(abs(found.offset_s - 0.001) < 1.96 * found.sigma_s)
    assert np.mean(inside) > 0.89  # with 95 %, 0.2 % of a hundred runs are below
