"""Measurements that contradict the others: which are left out, which count, and what is said of their frames."""

from __future__ import annotations

import warnings

import numpy as np
import pytest
from board_by_camera import X, noisy, poses, problem_of
from refinement_problems import KAPPA, SIGMA_M, copied, rig
from rwhec_factors import se3
from said import choice

import gtsam_rwhec as rw
from gtsam_rwhec.calibration.outliers import more_consistent, spare_equations
from gtsam_rwhec.calibration.trial_fits import implausible
from gtsam_rwhec.problem.measurements import Measurements, Pair
from gtsam_rwhec.simulate import Noise
from gtsam_rwhec.solver.free_directions import FreeReason


def with_outliers(problem: rw.Problem, share: float, of: tuple[str, ...] = ()) -> rw.Problem:
    rng = np.random.default_rng(1)

    def spoilt(pair: Pair, raw: Measurements) -> np.ndarray:
        B = raw.B.copy()
        if not of or pair.sensor in of:
            bad = rng.permutation(len(B))[: round(share * len(B))]
            B[bad, :3, 3] += rng.uniform(0.5, 2.0, (len(bad), 3))
        return B

    return copied(problem, B=spoilt)


def test_many_outliers_ask_whether_the_poses_belong_together() -> None:
    """Images that were paired with the next pose: 13 of 33 were left out, the camera was 0.5 m off, and it was USE."""
    calibration = rw.calibrate(with_outliers(rig().problem, 0.36))
    assert calibration.verdict is rw.Verdict.CARE
    assert calibration.judgement.grounds == (rw.Ground.MANY_OUTLIERS,)
    assert "of 80 measurements contradict the answer and were left out" in calibration.verdict_reason
    assert "check that each B belongs to its A" in calibration.verdict_reason


def test_outliers_are_left_out_and_the_rest_is_certified_again() -> None:
    simulated = rig()
    calibration = rw.calibrate(with_outliers(simulated.problem, 0.2))
    assert calibration.verdict is rw.Verdict.USE
    assert calibration.outliers.number == 16
    assert calibration.solution.counts.endswith("64 measurements")
    assert "16 of 80 measurements were left out (4 of 20 of target0-sensor0, " in str(choice(calibration, "outliers"))
    for name, truth in (simulated.X | simulated.Y).items():
        assert calibration.contains(name, truth, 0.9999)
    everything = rw.calibrate(with_outliers(simulated.problem, 0.2), rw.CalibrateOptions(robust="none"))
    assert everything.outliers.number == 0
    assert choice(everything, "outliers").evidence == "an option says so"
    assert everything.judgement.grounds == (rw.Ground.OUTLIERS_KEPT,)
    assert everything.verdict_reason.startswith("16 of 80 measurements look wrong ")
    assert 'CalibrateOptions(robust="auto") or --robust auto' in everything.verdict_reason
    good = rw.calibrate(simulated.problem, rw.CalibrateOptions(robust="none"))
    assert good.verdict is rw.Verdict.USE


def test_a_sensor_whose_measurements_disagree_is_not_to_be_used() -> None:
    calibration = rw.calibrate(with_outliers(rig(sensors=3).problem, 1.0, of=("sensor2",)))
    assert calibration.verdict is rw.Verdict.DO_NOT_USE
    assert rw.Ground.CONTRADICTED in calibration.judgement.grounds
    assert "sensor2" in calibration.verdict_reason


def test_two_measurements_are_too_few_to_leave_one_out() -> None:
    """Twelve equations, twelve unknowns."""
    raw = rig(1, 1).problem.measurements("target0", "sensor0")
    few = rw.Problem()
    few.add("target0", "sensor0", raw.A[:2], raw.B[:2])
    assert spare_equations(few) == 0
    calibration = rw.calibrate(few)
    assert calibration.judgement.grounds == (rw.Ground.NOT_UNIQUE,)
    assert calibration.verdict_reason.startswith("the measurements are too few (2 of a pair at most, ")
    assert calibration.verdict_reason.count("too few") == 1
    said = choice(calibration, "reading of A and B").evidence
    assert said == "2 measurements are too few to show a mistake of reading"
    assert {direction.reason for direction in calibration.refined.free_directions} == {FreeReason.FEW}
    assert choice(calibration, "outliers").chosen == "not looked for"
    assert "2 measurements are too few to tell a wrong one from the others; 4 more" in str(calibration)
    assert choice(calibration, "time offsets").evidence == "the measurements have no stamps"


def test_a_target_of_which_half_of_the_measurements_disagree_is_not_to_be_used() -> None:
    """Outliers that agree with each other, as the other pose of a planar target does, win by chance."""
    chance = np.random.default_rng(0)
    A = poses(chance, 30, 0.7, 0.3)
    turned = X @ se3.expmap(np.array([[0.0, 0.0, np.pi - 0.1, 0.0, 0.0, 0.0]]))[0]
    B = noisy(chance, A, 0.002, np.where(np.arange(30)[:, None, None] < 15, X, turned))
    calibration = rw.calibrate(problem_of(A, B))
    assert calibration.verdict is rw.Verdict.DO_NOT_USE


def with_a_third_camera(count: int, wrong: int) -> rw.Calibration:
    """A rig of two cameras and a third that has few measurements, some of them 0.4 m off."""
    simulated = rig(sensors=3, noise=Noise(0.001, 25.0 * KAPPA))
    problem = rw.Problem()
    for pair in simulated.problem.pairs:
        raw = simulated.problem.measurements(*pair)
        number = len(raw.A) if pair.sensor != "sensor2" else count if pair.target == "target0" else 0
        B = raw.B.copy()
        if pair.sensor == "sensor2":
            B[:wrong, :3, 3] += 0.4
        if number:
            problem.add(*pair, raw.A[:number], B[:number], raw.sigma[:number], raw.kappa[:number])
    return rw.calibrate(problem)


def test_two_measurements_of_a_sensor_that_contradict_each_other_contradict_it() -> None:
    """One of them is left out, and which one is chance."""
    calibration = with_a_third_camera(2, 1)
    assert calibration.verdict is rw.Verdict.DO_NOT_USE
    assert calibration.judgement.grounds == (rw.Ground.CONTRADICTED,)
    assert calibration.contradicted == ("sensor2",)
    assert "1 of 2 measurements of sensor2 contradict the answer" in calibration.verdict_reason


@pytest.mark.parametrize(
    ("count", "wrong", "words"),
    [
        (1, 1, "sensor2 rests on 1 measurement: a wrong one would not show"),
        (2, 0, "sensor2 rests on 2 measurements: a wrong one could not be told from the other"),
        (3, 0, ""),
    ],
)
def test_a_frame_that_rests_on_few_measurements_asks_for_care(count: int, wrong: int, words: str) -> None:
    calibration = with_a_third_camera(count, wrong)
    assert calibration.judgement.grounds == ((rw.Ground.FEW_MEASUREMENTS,) if words else ())
    assert calibration.verdict is (rw.Verdict.CARE if words else rw.Verdict.USE)
    assert words in calibration.verdict_reason


def test_residuals_of_no_sensor_are_implausible_whatever_the_option() -> None:
    """The option only says that other readings are not tried."""

    def exchanged(pair: Pair, raw: Measurements) -> np.ndarray:
        B = raw.B.copy()
        B[:, :3, :3] = B[:, :3, :3].transpose(0, 2, 1)
        return B

    problem = copied(rig().problem, B=exchanged)
    calibration = rw.calibrate(problem, rw.CalibrateOptions(misreadings=False))
    assert calibration.judgement.grounds[0] is rw.Ground.IMPLAUSIBLE
    assert calibration.implausible is not None
    assert calibration.misreadings == ()


def test_outliers_that_pull_the_fit_of_all_beyond_any_sensor_are_left_out() -> None:
    """Two of four targets exchanged their names half way: a consistent majority is left."""
    simulated = rig(targets=4, number_of_measurements=12)
    other = {"target0": "target1", "target1": "target0"}
    chance = np.random.default_rng(0)

    def exchanged(pair: Pair, raw: Measurements) -> np.ndarray:
        B = raw.B.copy()
        if pair.target in other:
            A, X, Y = raw.A[6:], simulated.X[other[pair.target]], simulated.Y[pair.sensor]
            B[6:] = np.linalg.inv(Y) @ A @ X @ se3.expmap(SIGMA_M * chance.normal(size=(6, 6)))
        return B

    problem = copied(simulated.problem, B=exchanged)
    with warnings.catch_warnings(action="ignore", category=rw.errors.WeightsWarning):
        assert implausible(problem, rw.solve(problem)) is not None
    calibration = rw.calibrate(problem)
    assert calibration.implausible is None
    assert calibration.outliers.number == 24
    assert calibration.contains("sensor0", simulated.Y["sensor0"], 0.9999)
    assert calibration.judgement.grounds == (rw.Ground.TARGET_CONTRADICTED,)
    assert "75 % of the measurements agree with one another" in choice(calibration, "reading of A and B").evidence


@pytest.mark.parametrize("seed", [7, 10])
def test_noise_stated_too_small_for_few_measurements_leaves_no_good_one_out(seed: int) -> None:
    """Six rows, 5 mm and 5 mrad, a third of which is stated: under it four rows agree."""
    chance = np.random.default_rng(seed)
    A = poses(chance, 6, 0.6, 0.3)
    problem = problem_of(A, noisy(chance, A, 5e-3), 5e-3 / 3.0, 0.5 / (5e-3 / 3.0) ** 2)
    calibration = rw.calibrate(problem, rw.CalibrateOptions(noise="given"))
    assert calibration.judgement.grounds == (rw.Ground.NOISE_UNDERSTATED,)
    assert calibration.outliers.number == 0


COUNT, GOOD = 30, 14


def with_flipped(seed: int, wrong_noise: float) -> rw.Problem:
    """14 good measurements, and 16 of a board turned by half a turn, with another noise."""
    chance = np.random.default_rng(seed)

    X, Y = poses(chance, 2, 1.0, 0.4)
    A = poses(chance, COUNT, 0.6, 0.3)
    B = np.linalg.inv(Y) @ A @ X @ poses(chance, COUNT, 2e-3, 2e-3)
    flip = np.diag([-1.0, -1.0, 1.0, 1.0])
    B[GOOD:] = B[GOOD:] @ flip @ poses(chance, COUNT - GOOD, wrong_noise, 0.3 * wrong_noise)
    return problem_of(A, B)


def chosen(problem: rw.Problem, kept: np.ndarray) -> np.ndarray | None:
    (pair,) = problem.pairs
    found = more_consistent(problem, {pair: kept})
    return None if found is None else found[pair]


def test_what_agrees_far_better_with_itself_counts() -> None:
    kept = np.arange(COUNT) >= GOOD
    kept[:2] = True  # good ones between the flipped
    found = chosen(with_flipped(0, 0.12), kept)
    assert found is not None
    assert found[:GOOD].all()
    assert not found[GOOD:].any()


def test_a_choice_that_is_right_stands() -> None:
    good = np.arange(COUNT) < GOOD
    assert chosen(with_flipped(1, 0.12), good) is None  # what was left out agrees less
    assert chosen(with_flipped(2, 2e-3), good) is None  # as well
    assert chosen(with_flipped(3, 0.12), np.arange(COUNT) < COUNT - 5) is None  # few were left out


def test_half_flipped_measurements_are_not_to_be_used_and_the_good_ones_are_kept() -> None:
    """18 of 30 were kept with a noise of 8 degrees: USE, and the camera upside down."""
    problem = with_flipped(0, 0.12)
    calibration = rw.calibrate(problem)
    (pair,) = problem.pairs
    assert calibration.verdict is rw.Verdict.DO_NOT_USE
    assert calibration.outliers.inliers[pair][:GOOD].all()
    assert not calibration.outliers.inliers[pair][GOOD:].any()
