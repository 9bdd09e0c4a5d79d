"""A fallback is never USE: what cannot be used is left out alone, and a check that could not run is named."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import synthetic_logs as made
from board_by_camera import Y, noisy, poses, problem_of
from problems_of_corners import problem_of as problem_of_corners
from said import choice

import gtsam_rwhec as rw
from gtsam_rwhec.calibration.calibrate_options import Recording
from gtsam_rwhec.fitting import noise_refinement
from gtsam_rwhec.geometry import Trajectory
from gtsam_rwhec.geometry.poses import Array

sys.path.insert(0, str(Path(__file__).parents[1] / "fitting"))
from simulated_cells import cell  # isort: skip

pytestmark = pytest.mark.filterwarnings("ignore::gtsam_rwhec.errors.RwhecWarning")


def ns(seconds: Array) -> np.ndarray:
    return np.round(1e9 * seconds).astype(np.int64)


def path(hertz: float, *, without: tuple[float, float] = (0.0, 0.0)) -> Trajectory:
    """A hand that swings about all axes, logged for 15 s; no poses from ``without`` to its end."""
    seconds = np.arange(-1.0, 15.0, 1.0 / hertz)
    seconds = seconds[(seconds <= without[0]) | (seconds >= without[1])]
    return Trajectory.of(ns(seconds), np.array([made.hand(float(t)) for t in seconds]))


def stream(seconds: Array, *, A: Array | None = None, wrong: Array | list[int] = (), late_s: float = 0.0) -> rw.Problem:
    """Measurements of a moving camera, some of which are 0.8 m off, each elsewhere."""
    chance = np.random.default_rng(0)
    true = np.array([made.hand(float(t)) for t in seconds + late_s])
    B = noisy(chance, true, 0.002)
    off = chance.normal(size=(len(wrong), 3))
    B[np.array(wrong, dtype=int), :3, 3] += 0.8 * off / np.linalg.norm(off, axis=1)[:, None]
    if A is None:
        A = np.array([made.hand(float(t)) for t in seconds])
    return problem_of(A, B, stamps_ns=ns(seconds))


def unchecked(calibration: rw.Calibration) -> str:
    """The words about what could not be checked; the verdict is CARE at best."""
    assert calibration.verdict is not rw.Verdict.USE
    (words,) = [one.words for one in calibration.findings if one.ground is rw.Ground.NOT_CHECKED]
    assert words in calibration.verdict_reason
    return words


@pytest.mark.parametrize("asked", ["auto", True])
def test_a_measurement_in_a_gap_of_the_path_does_not_end_the_model_of_the_noise(asked: bool) -> None:
    """It was left out as an outlier, and judging it again raised: B's noise alone was estimated, and it was USE."""
    logged = path(50.0, without=(5.25, 6.75))
    seconds = np.r_[np.arange(0.0, 5.1, 0.2), 6.0, np.arange(6.9, 12.0, 0.2)]
    problem = stream(seconds, A=logged.at(ns(seconds))[0])
    found = rw.calibrate(problem, rw.CalibrateOptions(carrier_path=logged, time_offsets=asked))
    assert found.noise.model is not None
    assert found.noise.model.carrier_noise is not None
    assert found.outliers.number == 1
    assert found.verdict is rw.Verdict.USE
    assert found.contains("camera", Y, 0.9999)


def test_a_measurement_whose_neighbours_are_outliers_counts_without_its_clock() -> None:
    """Without a path: 99 measurements were "too few to tell how well the poses are known"."""
    seconds = np.r_[np.arange(0.0, 6.0, 0.1), 7.4, 8.2, 9.0, np.arange(10.4, 14.0, 0.1)]
    found = rw.calibrate(stream(seconds, wrong=[60, 62], late_s=0.01))
    assert found.noise.model is not None
    assert found.time_offsets_s["camera"] == pytest.approx(0.01, abs=0.003)
    said = "1 of 97 measurements count as they are paired, without an offset (board-camera at 8200000000 ns)"
    assert said in choice(found, "time offsets").evidence
    assert found.outliers.inliers[problem_pair(found)][61]
    assert found.contains("camera", Y, 0.9999)


def problem_pair(found: rw.Calibration) -> tuple[str, str]:
    (pair,) = found.outliers.inliers
    return pair


@pytest.mark.parametrize("offsets", ["auto", ()])
def test_a_clock_that_a_path_does_not_tell_is_not_checked(offsets: tuple[str, ...]) -> None:
    found = rw.calibrate(
        stream(np.arange(0.05, 12.0, 0.5)), rw.CalibrateOptions(carrier_path=path(2.0), time_offsets=offsets)
    )
    assert unchecked(found).startswith("the clock of camera could not be checked: the carriers' path about its stamps ")


def test_a_log_with_a_gap_in_its_path_has_an_answer(tmp_path: Path) -> None:
    """One image where the hand's poses are 0.4 s apart for a while: calibrating the whole log raised a CountError."""

    def is_kept(message: made.Message) -> bool:
        t = (message.stamp_ns - made.BEGIN_NS) * 1e-9
        if message.topic == "/tf":
            return not 4.2 < t < 5.8 or round(50.0 * t) % 20 == 0
        return not 4.0 < t < 6.0 or (message.topic == "/cam_0/tags" and abs(t - 4.8) < 0.05)

    estimated = {name: f"detections: /{name}/tags\n    time_offset: estimate" for name in made.CAMERAS}
    text = made.rig_text(**estimated).replace("max_gap_s: 0.2", "max_gap_s: 2.0")
    solved = made.solved(tmp_path, filter(is_kept, made.recording(10.0)), text)
    assert solved.calibration.noise.model is not None
    assert "so 3 of 240 measurements count as they are paired" in choice(solved.calibration, "time offsets").evidence
    for name, truth in made.Y.items():
        assert solved.refined.contains(name, truth, 0.9999)


def good(count: int = 30, seed: int = 0, size: float = 1.0) -> rw.Problem:
    chance = np.random.default_rng(seed)
    A = poses(chance, count, 0.7, 0.3)
    B = noisy(chance, A, 0.001)
    B[:, :3, 3] *= size
    return problem_of(A, B)


def test_more_measurements_than_the_model_of_the_noise_can_hold_are_said(monkeypatch: pytest.MonkeyPatch) -> None:
    """A real problem of that size (450 targets) takes 17 s: so the bound is lower here."""
    assert rw.calibrate(good()).verdict is rw.Verdict.USE
    monkeypatch.setattr(noise_refinement, "MOST_NUMBERS", 1000)
    found = rw.calibrate(good())
    assert found.noise.model is None
    words = "noise of A, drift and errors that vary with the configuration were not looked for: 30 measurements of 12 "
    assert unchecked(found).startswith(words)
    assert found.judgement.grounds == (rw.Ground.NOT_CHECKED,)


def fixed(count: int, size: float = 1.0) -> rw.Problem:
    problem = good(count, size=size)
    problem.fix("camera", Y)
    return problem


def test_a_stated_pose_that_nothing_can_be_compared_with_is_said() -> None:
    found = rw.calibrate(fixed(2))
    words = "the stated poses of camera could not be compared with the measurements, which give none alone"
    assert unchecked(found) == words
    assert choice(found, "stated poses").evidence == "the measurements alone give no answer to compare them with"


def test_a_size_that_hangs_on_single_measurements_is_said() -> None:
    """It looks 5 % wrong; without either measurement there is no answer, and nothing was said."""
    found = rw.calibrate(fixed(2, size=1.05))
    assert (
        unchecked(found)
        == "the stated size of board could not be compared with the motion: it hangs on few measurements"
    )
    assert found.sizes[0].is_untested


@pytest.mark.parametrize(
    ("sizes", "clocks", "of_A"), [("check", "auto", 0.02), ("check", False, 0), ("correct", False, 0.02)]
)
def test_too_much_noise_of_A_or_clocks_that_are_chosen_do_not_end_the_check_of_sizes(
    sizes: Any, clocks: Any, of_A: float
) -> None:
    """With either, a board that is 5 % too large was not told."""
    noise = rw.CarrierNoise(of_A, of_A) if of_A else None
    found = rw.calibrate(good(size=1.05), rw.CalibrateOptions(sizes=sizes, carrier_noise=noise, time_offsets=clocks))
    assert set(found.judgement.grounds) & {rw.Ground.SIZE_DOUBTED, rw.Ground.NO_SIZE_FITS}
    assert [one.what for one in found.choices].count("sizes of targets") == 1


def test_poses_that_cleaning_removed_and_that_have_no_answer_are_not_checked_for_misreadings() -> None:
    def of_any_scale(sign: float) -> rw.Problem:
        raw, problem = good().measurements("board", "camera"), rw.Problem("shared")
        B = raw.B.copy()
        B[:, :3, 3] *= sign
        problem.add("board", "camera", raw.A, B)
        return problem

    found = rw.calibrate(of_any_scale(1.0), recording=Recording(uncleaned=of_any_scale(-1.0)))
    assert unchecked(found).startswith("whether the poses were misread was not looked for among what cleaning removed")


def test_too_few_images_to_leave_some_out_are_said() -> None:
    found = rw.calibrate(problem_of_corners(cell(7, cameras=1, images=7).observations))
    assert found.refined is not None
    assert found.refined.reprojection is not None
    assert unchecked(found).startswith("systematic errors of the arm or of the targets were not looked for in images")


@pytest.mark.parametrize(
    ("seconds", "share", "grounds"),
    [
        (np.arange(0.0, 10.0, 0.1), 0.10, ()),
        (np.arange(0.0, 10.0, 0.1), 0.18, (rw.Ground.MANY_OUTLIERS,)),
        (np.arange(0.0, 400.0, 4.0), 0.18, ()),  # of stations, 30 % count
    ],
)
def test_a_fifth_of_a_stream_is_many_outliers(seconds: Array, share: float, grounds: tuple[rw.Ground, ...]) -> None:
    wrong = np.random.default_rng(5).permutation(len(seconds))[: round(share * len(seconds))]
    found = rw.calibrate(stream(seconds, wrong=wrong))
    assert found.outliers.number == len(wrong)
    assert found.judgement.grounds == grounds
