"""One call: the best answer, with a verdict and every choice said."""

from __future__ import annotations

import re
import warnings

import numpy as np
import pytest
from board_by_camera import X, Y, noisy, poses, problem_of
from refinement_problems import KAPPA, SIGMA_M, copied, rig
from rwhec_factors import se3
from said import choice

import gtsam_rwhec as rw
from gtsam_rwhec.errors import NoiseError, OptionError
from gtsam_rwhec.problem.measurements import Measurements, Pair
from gtsam_rwhec.simulate import Noise


def test_a_good_problem_is_to_be_used_and_its_truth_is_inside() -> None:
    simulated = rig()
    with warnings.catch_warnings(action="error"):
        calibration = rw.calibrate(simulated.problem)
    assert calibration.verdict is rw.Verdict.USE
    assert calibration.judgement.grounds == ()
    assert calibration.solution.certificate.is_certified
    assert calibration.refined is not None
    assert calibration.X is calibration.refined.X
    for name, truth in (simulated.X | simulated.Y).items():
        assert calibration.contains(name, truth, 0.9999)
    assert choice(calibration, "outliers").chosen == "none"
    said = choice(calibration, "noise of A and B")
    assert said.chosen.startswith("estimated, for each axis 0.5° and 4.9 mm for B, ")
    assert said.evidence == "that is what the residuals of 80 measurements show"
    said = choice(calibration, "systematic errors")
    assert re.fullmatch(r"none found; what hides is in the covariances as \d+ % probable", said.chosen)
    assert "explains the residuals hardly better (evidence " in said.evidence
    assert calibration.noise.model is not None
    assert str(calibration.noise).startswith("Noise of B for each axis: ")
    assert "No outliers among 80 measurements" in str(calibration.outliers)
    assert str(calibration).startswith("Use these poses: the measurements determine every pose, and nothing ")


def test_the_accuracy_of_an_arm_is_in_the_covariance_of_what_it_carries() -> None:
    """No residual shows a constant error of an arm: the answers are alike, and the stated one is as wide as it is."""
    problem = rig().problem
    plain = rw.calibrate(problem)
    accuracy = rw.ArmAccuracy(rotation_rad=0.02, translation_m=0.01)
    stated = rw.calibrate(problem, rw.CalibrateOptions(systematic=accuracy))
    assert choice(stated, "accuracy of the arm").chosen == "1.1° and 10 mm for each axis, as you stated"
    assert stated.noise.model is not None
    constant = np.array(stated.noise.model.constant_deviations)
    assert constant == pytest.approx(np.tile([0.02] * 3 + [0.01] * 3, (2, 1)), rel=0.2)
    for name in problem.targets + problem.sensors:
        turns = [one.standard_deviations(name)[0].min() for one in (plain, stated)]
        assert turns[0] < 0.7 < turns[1]
    options = rw.CalibrateOptions(noise="given", systematic=accuracy)
    given = rw.calibrate(copied(problem, sigma=lambda pair, raw: raw.sigma), options)
    assert given.noise.model is None  # and the accuracy counts all the same
    assert choice(given, "accuracy of the arm").chosen == choice(stated, "accuracy of the arm").chosen
    assert min(given.standard_deviations(name)[0].min() for name in problem.targets + problem.sensors) > 1.1
    with pytest.raises(NoiseError, match=r"ArmAccuracy.rotation_rad is 0.0; give a positive standard deviation"):
        rw.ArmAccuracy(0.0, 0.01)
    with pytest.raises(OptionError, match="give True, False or an ArmAccuracy"):
        rw.CalibrateOptions(systematic=0.1)  # type: ignore[arg-type]


@pytest.mark.parametrize("robust", ["auto", "none"])
def test_noise_that_is_stated_too_small_is_said_with_its_factor(robust: str) -> None:
    """Nothing agrees under it; that is no sign of a frame that has moved."""
    problem = copied(rig().problem, sigma=lambda pair, raw: raw.sigma / 30.0, kappa=lambda pair, raw: 900.0 * raw.kappa)
    calibration = rw.calibrate(problem, rw.CalibrateOptions(noise="given", robust=robust))  # type: ignore[arg-type]
    assert calibration.judgement.grounds == (rw.Ground.NOISE_UNDERSTATED,)
    assert calibration.verdict_reason.startswith("the residuals are 30 times as large as the stated noise allows")
    assert "--noise auto" in calibration.verdict_reason
    assert calibration.outliers.number == 0
    assert rw.calibrate(rig().problem, rw.CalibrateOptions(noise="given", robust=robust)).judgement.grounds == ()  # type: ignore[arg-type]


def test_a_size_that_the_motion_contradicts_is_found() -> None:
    def larger(pair: Pair, raw: Measurements) -> np.ndarray:
        B = raw.B.copy()
        B[:, :3, 3] *= 1.03 if pair.target == "target1" else 1.0
        return B

    problem = copied(rig(noise=Noise(0.001, 50.0 * KAPPA), number_of_measurements=30).problem, B=larger)
    calibration = rw.calibrate(problem)
    assert calibration.judgement.grounds[0] is rw.Ground.SIZE_DOUBTED
    assert [size.target for size in calibration.sizes if size.is_doubted] == ["target1"]
    assert calibration.contradicted == ("target1",)
    assert 'rw.Problem(scale="per_target") or --scale per_target' in calibration.verdict_reason
    assert "the stated size of target1 is 3 % larger than the motion says" in calibration.verdict_reason
    told = rw.calibrate(problem, rw.CalibrateOptions(sizes="known"))
    assert rw.Ground.SIZE_DOUBTED not in told.judgement.grounds
    assert choice(told, "sizes of targets").evidence == "an option says so"


@pytest.mark.filterwarnings("ignore::gtsam_rwhec.errors.UnitsWarning")
def test_millimetres_in_both_are_found_in_the_lengths() -> None:
    """They change no residual."""

    def thousandfold(poses: np.ndarray) -> np.ndarray:
        return np.concatenate([np.c_[poses[:, :3, :3], 1e3 * poses[:, :3, 3:]], poses[:, 3:]], axis=1)

    problem = copied(
        rig().problem,
        A=lambda pair, raw: thousandfold(raw.A),
        B=lambda pair, raw: thousandfold(raw.B),
        sigma=lambda pair, raw: 1e3 * raw.sigma,
    )
    calibration = rw.calibrate(problem)
    assert calibration.judgement.grounds == (rw.Ground.MISREAD,)
    assert "this looks like millimetres in A and B" in calibration.verdict_reason
    assert not any("in another unit than metres" in words for words in calibration.cannot_tell)
    assert calibration.refined is None
    assert calibration.points == {}
    assert [choice.what for choice in calibration.choices] == ["reading of A and B"]
    assert not any("no likely mistake" in str(choice) for choice in calibration.choices)


def test_planar_motion_is_not_determined() -> None:
    calibration = rw.calibrate(rig(1, 1, motion="planar").problem)
    assert calibration.verdict is rw.Verdict.DO_NOT_USE
    assert calibration.judgement.grounds[0] is rw.Ground.NOT_UNIQUE
    assert "turn the carriers about at least two different axes" in calibration.verdict_reason
    assert all("is not determined" in str(point) for point in calibration.points.values())


def test_too_few_measurements_say_which_choice_was_not_made_and_why() -> None:
    """A target that was seen once takes up its one measurement, and nothing is left to tell its noise."""
    problem = rig().problem
    raw = problem.measurements("target0", "sensor0")
    once = rw.Problem()
    once.add("target0", "sensor0", raw.A, raw.B)
    other = problem.measurements("target1", "sensor0")
    once.add("target1", "sensor0", other.A[:1], other.B[:1])
    calibration = rw.calibrate(once, rw.CalibrateOptions(noise_groups="pair"))
    assert calibration.verdict is rw.Verdict.DO_NOT_USE
    assert calibration.judgement.grounds == (rw.Ground.NO_COVARIANCE,)
    assert calibration.refined is None
    assert calibration.X is calibration.solution.X
    assert "of target1-sensor0 cannot be estimated" in choice(calibration, "covariances").evidence
    with pytest.raises(rw.errors.UnderdeterminedError, match="has no covariances"):
        calibration.covariance("sensor0")


def test_drift_that_cannot_be_looked_for_says_why() -> None:
    """Rows of one pair are taken to be in order of time, and 7 are too few."""
    raw = rig(1, 1).problem.measurements("target0", "sensor0")
    said = []
    for count in (7, 15):
        problem = rw.Problem()
        problem.add("target0", "sensor0", raw.A[:count], raw.B[:count])
        said.append(choice(rw.calibrate(problem), "drift"))
    assert (said[0].chosen, said[0].evidence) == (
        "no model of it was tried",
        "it takes 8 instants of each pair, one after the other",
    )
    assert said[1].chosen == "none"
    assert "since they have no stamps" in said[1].evidence


def test_millimetres_in_A_are_said_once() -> None:
    def thousandfold(pair: Pair, raw: Measurements) -> np.ndarray:
        A = raw.A.copy()
        A[:, :3, 3] *= 1e3
        return A

    with pytest.warns(rw.errors.UnitsWarning) as caught:
        problem = copied(rig().problem, A=thousandfold)
    (warning,) = caught  # of four pairs
    assert "translations of A have a median size of 823.7; this looks like millimetres" in str(warning.message)
    calibration = rw.calibrate(problem)
    assert calibration.verdict_reason.count("millimetres") == 1
    assert "A and B" not in calibration.verdict_reason


def test_stated_noise_serves_where_the_residuals_are_too_few() -> None:
    problem = rig().problem
    once = rw.Problem()
    for target, number in (("target0", 20), ("target1", 1)):
        raw = problem.measurements(target, "sensor0")
        once.add(target, "sensor0", raw.A[:number], raw.B[:number], SIGMA_M, KAPPA)
    calibration = rw.calibrate(once, rw.CalibrateOptions(noise_groups="pair"))
    assert calibration.refined is not None
    assert calibration.refined.noise_source == "given"
    assert choice(calibration, "noise of B").evidence == "the residuals are too few to estimate it"


def test_moments_alone_are_calibrated_without_outliers() -> None:
    simulated = rig()
    kept = rw.Problem(keep_measurements=False)
    for pair in simulated.problem.pairs:
        raw = simulated.problem.measurements(*pair)
        kept.add(*pair, raw.A, raw.B, raw.sigma, raw.kappa)
    calibration = rw.calibrate(kept)
    assert calibration.judgement.grounds == (rw.Ground.NOT_CHECKED,)
    assert "the raw measurements were not kept, so outliers, mistakes of reading, " in calibration.verdict_reason
    assert choice(calibration, "outliers").evidence == "the raw measurements were not kept"
    assert choice(calibration, "noise").evidence == "the raw measurements were not kept"
    for name, value in (("carrier_noise", rw.CarrierNoise(0.001, 0.001)), ("time_offsets", True)):
        with pytest.raises(rw.errors.MeasurementsNotKeptError, match=f"^CalibrateOptions.{name} needs the raw "):
            rw.calibrate(kept, rw.CalibrateOptions(**{name: value}))  # type: ignore[arg-type]
    kept.add("target0", "sensor0", raw.A, raw.B, covariances=np.tile(1e-4 * np.eye(6), (len(raw.A), 1, 1)))
    with pytest.raises(rw.errors.MeasurementsNotKeptError, match="whose measurements have covariances"):
        rw.calibrate(kept)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"noise": "guess"}, "noise='guess' is not one of"),
        ({"robust": "huber"}, "robust='huber' is not one of"),
        ({"level": 1.0}, "level=1.0; give one between 0 and 1"),
        ({"time_offsets": "always"}, "time_offsets='always'"),
        ({"time_offsets": np.array(["sensor0"])}, "give 'auto', True, False, or a tuple of sensors' names"),
        ({"time_offsets": (3,)}, "give 'auto', True, False, or a tuple of sensors' names"),
        ({"carrier_noise": 0.1}, "carrier_noise is a float; give CarrierNoise"),
    ],
)
def test_options_that_are_not_valid_are_refused(options: dict[str, object], words: str) -> None:
    with pytest.raises(rw.errors.OptionError, match=words):
        rw.CalibrateOptions(**options)  # type: ignore[arg-type]


def test_input_that_cannot_be_used_raises() -> None:
    with pytest.raises(rw.errors.OptionError, match="the problem is a str"):
        rw.calibrate("cell")  # type: ignore[arg-type]
    with pytest.raises(rw.errors.CountError, match="the problem is empty"):
        rw.calibrate(rw.Problem())
    simulated = rig()
    with pytest.raises(rw.errors.OptionError, match="names 'cam', which is not a sensor"):
        rw.calibrate(simulated.problem, rw.CalibrateOptions(time_offsets=("cam",)))
    relative = copied(simulated.problem, sigma=lambda pair, raw: None, kappa=lambda pair, raw: None)
    with pytest.raises(rw.errors.OptionError, match="noise='given', but"):
        rw.calibrate(relative, rw.CalibrateOptions(noise="given"))
    with pytest.raises(rw.errors.NoiseError, match="give a positive standard deviation"):
        rw.CalibrateOptions(carrier_noise=rw.CarrierNoise(0.0, 0.001))


def measured() -> tuple[np.ndarray, np.ndarray]:
    """A, and B with 1 mm and 1 mrad of noise."""
    chance = np.random.default_rng(3)
    A = poses(chance, 20, 0.6, 0.3)
    return A, noisy(chance, A, 1e-3)


@pytest.mark.parametrize("both", [False, True])
def test_a_fixed_target_whose_size_is_known_is_calibrated(both: bool, capfd: pytest.CaptureFixture[str]) -> None:
    problem = problem_of(*measured())
    problem.fix("board", X)
    if both:
        problem.fix("camera", Y)
    calibration = rw.calibrate(problem)
    assert calibration.verdict is rw.Verdict.USE
    assert calibration.sizes[0].scale == pytest.approx(1.0, abs=0.01)
    assert calibration.sizes[0].sigma is not None
    assert not capfd.readouterr().out  # LAPACK writes there


def test_a_wrong_size_of_a_fixed_target_is_doubted() -> None:
    A, B = measured()
    B[:, :3, 3] *= 1.05
    problem = problem_of(A, B)
    problem.fix("board", X)
    assert rw.Ground.SIZE_DOUBTED in rw.calibrate(problem).judgement.grounds


def test_more_noise_stated_for_A_than_the_residuals_have_asks_for_care() -> None:
    problem = problem_of(*measured())
    calibration = rw.calibrate(problem, rw.CalibrateOptions(carrier_noise=rw.CarrierNoise(0.01, 0.01)))
    assert calibration.judgement.grounds == (rw.Ground.NOISE_OVERSTATED,)
    assert calibration.verdict is rw.Verdict.CARE
    assert "than the noise that you stated for A makes them" in calibration.verdict_reason
    assert choice(calibration, "noise of A").chosen == "0.57° and 10 mm for each axis, as you stated"
    assert calibration.contains("board", X)
    covariances = {problem.pairs[0]: np.tile(1e-4 * np.eye(6), (20, 1, 1))}
    calibration = rw.calibrate(problem, rw.CalibrateOptions(carrier_noise=rw.CarrierNoise(covariances=covariances)))
    assert calibration.verdict is rw.Verdict.CARE
    assert "stated for A was not used" in choice(calibration, "noise").evidence
    assert calibration.contains("board", X)


def test_motions_alone_say_nothing_of_an_empty_mean() -> None:
    A, _ = measured()
    problem = rw.Problem()
    noise = 1e-3 * np.random.default_rng(4).normal(size=(len(A), 6))
    problem.add_motion("camera", A, np.linalg.inv(Y) @ A @ Y @ se3.expmap(noise))
    with warnings.catch_warnings(action="error", category=RuntimeWarning):
        calibration = rw.calibrate(problem)
    assert calibration.contains("camera", Y, 0.9999)


@pytest.mark.filterwarnings("ignore::gtsam_rwhec.errors.UnitsWarning")
def test_a_noise_model_that_cannot_be_computed_is_said_and_b_alone_is_estimated() -> None:
    """A map whose origin is 100,000 km away: the whole model has no Cholesky factor in double precision."""
    A, _ = measured()
    A[:, 0, 3] += 1e8
    problem = problem_of(A, noisy(np.random.default_rng(4), A, 1e-3))
    calibration = rw.calibrate(problem, rw.CalibrateOptions(misreadings=False))
    assert calibration.noise.has_failed
    assert calibration.noise.model is None
    assert "could not be computed" in choice(calibration, "noise").evidence
    assert rw.Ground.COVARIANCE_DOUBTED in calibration.judgement.grounds
    assert calibration.verdict is not rw.Verdict.USE


def test_three_stations_are_too_few_for_a_covariance_that_is_relied_on() -> None:
    chance = np.random.default_rng(0)
    A = poses(chance, 3, 0.7, 0.3)
    B = noisy(chance, A, 0.001)
    calibration = rw.calibrate(problem_of(A, B))
    assert calibration.verdict is not rw.Verdict.USE
    assert "3 measurements are too few to tell how large their noise is" in calibration.verdict_reason
    given = problem_of(A, B, 0.001, 5e5)
    assert "too few" not in rw.calibrate(given, rw.CalibrateOptions(noise="given")).verdict_reason


def test_copies_of_measurements_count_once() -> None:
    """A file that was written twice made deviations 1.4 times as small: in 4 of 100 USE with chi2 of 37 and more."""
    chance = np.random.default_rng(5)
    A = poses(chance, 20, 0.6, 0.3)
    B = noisy(chance, A, 2e-3)
    once = rw.calibrate(problem_of(A, B))
    copied_rows = problem_of(np.concatenate([A, A[::2]]), np.concatenate([B, B[::2]]))
    twice = rw.calibrate(copied_rows)
    np.testing.assert_allclose(twice.Y["camera"].matrix(), once.Y["camera"].matrix(), atol=1e-9)
    np.testing.assert_allclose(twice.covariance("camera"), once.covariance("camera"), rtol=1e-4, atol=1e-12)
    assert twice.notes[0] == "10 of 30 measurements are copies of others, to the last digit: each counts once"
    assert rw.results.evidence_of(copied_rows, twice).residuals is not None
