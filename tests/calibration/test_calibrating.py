"""One call: the best answer, with a verdict and every choice said."""

from __future__ import annotations

import warnings

import numpy as np
import pytest
from refinement_problems import KAPPA, SIGMA_M, copied, rig
from rwhec_factors import se3

import gtsam_rwhec as rw
from gtsam_rwhec.calibration.outlier_stage import spare_equations
from gtsam_rwhec.calibration.plausibility import implausible
from gtsam_rwhec.identifiability.free_directions import FreeReason
from gtsam_rwhec.problem.measurements import Measurements
from gtsam_rwhec.problem.pairs import Pair
from gtsam_rwhec.simulate import Noise


def choice(calibration: rw.Calibration, what: str) -> rw.Choice:
    return next(choice for choice in calibration.choices if choice.what == what)


def test_a_good_problem_is_to_be_used_and_its_truth_is_inside() -> None:
    simulated = rig()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
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
    assert said.chosen.startswith("estimated, for each axis 0.5° and 4.8 mm for B, ")
    assert said.evidence == "that is what the residuals of 80 measurements show"
    said = choice(calibration, "systematic errors")
    assert said.chosen == "none found; the covariances hold as much as could hide"
    assert "explains the residuals hardly better (evidence " in said.evidence
    assert calibration.noise.model is not None
    assert str(calibration.noise).startswith("Noise of B for each axis: ")
    assert "No outliers among 80 measurements" in str(calibration.outliers)
    assert str(calibration).startswith("Use these poses: the measurements determine every pose, and nothing ")


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


def test_a_sensor_whose_measurements_disagree_is_not_to_be_used() -> None:
    calibration = rw.calibrate(with_outliers(rig(sensors=3).problem, 1.0, of=("sensor2",)))
    assert calibration.verdict is rw.Verdict.DO_NOT_USE
    assert rw.Ground.CONTRADICTED in calibration.judgement.grounds
    assert "sensor2" in calibration.verdict_reason


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


def test_drift_that_cannot_be_looked_for_says_why() -> None:
    """Rows of one pair are taken to be in order of time, and 15 are too few."""
    raw = rig(1, 1).problem.measurements("target0", "sensor0")
    said = []
    for count in (15, 20):
        problem = rw.Problem()
        problem.add("target0", "sensor0", raw.A[:count], raw.B[:count])
        said.append(choice(rw.calibrate(problem), "drift"))
    assert (said[0].chosen, said[0].evidence) == (
        "no model of it was tried",
        "it takes 20 instants of each pair, one after the other",
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
    assert calibration.verdict is rw.Verdict.USE
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
        ({"carrier_noise": 0.1}, "carrier_noise is a float; give a CarrierNoise"),
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


def test_a_target_of_which_half_of_the_measurements_disagree_is_not_to_be_used() -> None:
    """Outliers that agree with each other, as the other pose of a planar target does, win by chance."""
    chance = np.random.default_rng(0)
    A = se3.expmap(np.hstack([0.7 * chance.normal(size=(30, 3)), 0.3 * chance.normal(size=(30, 3))]))
    X, Y = se3.expmap(np.array([[0.3, 0.1, -0.2, 0.1, 0.0, 0.2], [1.0, 0.3, -0.5, 0.5, 0.4, 0.6]]))
    turned = X @ se3.expmap(np.array([[0.0, 0.0, np.pi - 0.1, 0.0, 0.0, 0.0]]))[0]
    B = np.linalg.inv(Y) @ A @ np.where(np.arange(30)[:, None, None] < 15, X, turned)
    problem = rw.Problem()
    problem.add("board", "camera", A, B @ se3.expmap(0.002 * chance.normal(size=(30, 6))))
    calibration = rw.calibrate(problem)
    assert calibration.verdict is rw.Verdict.DO_NOT_USE


def exact_and_truth(count: int = 20) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """A, B with 1 mm and 1 mrad of noise, X and Y of one sensor and one target."""
    chance = np.random.default_rng(3)
    A = se3.expmap(np.hstack([0.6 * chance.normal(size=(count, 3)), 0.3 * chance.normal(size=(count, 3))]))
    X, Y = se3.expmap(np.array([[0.3, 0.1, -0.2, 0.1, 0.0, 0.2], [1.0, 0.3, -0.5, 0.5, 0.4, 0.6]]))
    return A, np.linalg.inv(Y) @ A @ X @ se3.expmap(1e-3 * chance.normal(size=(count, 6))), X, Y


@pytest.mark.parametrize("both", [False, True])
def test_a_fixed_target_whose_size_is_known_is_calibrated(both: bool, capfd: pytest.CaptureFixture[str]) -> None:
    A, B, X, Y = exact_and_truth()
    problem = rw.Problem()
    problem.add("board", "camera", A, B)
    problem.fix("board", X)
    if both:
        problem.fix("camera", Y)
    calibration = rw.calibrate(problem)
    assert calibration.verdict is rw.Verdict.USE
    assert calibration.sizes[0].scale == pytest.approx(1.0, abs=0.01)
    assert calibration.sizes[0].sigma is not None
    assert not capfd.readouterr().out  # LAPACK writes there


def test_a_wrong_size_of_a_fixed_target_is_doubted() -> None:
    A, B, X, _ = exact_and_truth()
    B[:, :3, 3] *= 1.05
    problem = rw.Problem()
    problem.add("board", "camera", A, B)
    problem.fix("board", X)
    assert rw.Ground.SIZE_DOUBTED in rw.calibrate(problem).judgement.grounds


def test_more_noise_stated_for_A_than_the_residuals_have_asks_for_care() -> None:
    A, B, X, _ = exact_and_truth()
    problem = rw.Problem()
    problem.add("board", "camera", A, B)
    calibration = rw.calibrate(problem, rw.CalibrateOptions(carrier_noise=rw.CarrierNoise(0.01, 0.01)))
    assert calibration.judgement.grounds == (rw.Ground.NOISE_OVERSTATED,)
    assert calibration.verdict is rw.Verdict.CARE
    assert "than the noise that you stated for A makes them" in calibration.verdict_reason
    assert choice(calibration, "noise of A").chosen == "0.57° and 10 mm for each axis, as you stated"
    assert calibration.contains("board", X)
    covariances = {problem.pairs[0]: np.tile(1e-4 * np.eye(6), (len(A), 1, 1))}
    calibration = rw.calibrate(problem, rw.CalibrateOptions(carrier_noise=rw.CarrierNoise(covariances=covariances)))
    assert calibration.verdict is rw.Verdict.CARE
    assert "stated for A was not used" in choice(calibration, "noise").evidence
    assert calibration.contains("board", X)


def test_motions_alone_say_nothing_of_an_empty_mean() -> None:
    A, _, _, Y = exact_and_truth()
    problem = rw.Problem()
    noise = 1e-3 * np.random.default_rng(4).normal(size=(len(A), 6))
    problem.add_motion("camera", A, np.linalg.inv(Y) @ A @ Y @ se3.expmap(noise))
    with warnings.catch_warnings():
        warnings.simplefilter("error", RuntimeWarning)
        calibration = rw.calibrate(problem)
    assert calibration.contains("camera", Y, 0.9999)


@pytest.mark.filterwarnings("ignore::gtsam_rwhec.errors.UnitsWarning")
def test_a_noise_model_that_cannot_be_computed_is_said_and_b_alone_is_estimated() -> None:
    """A map whose origin is 100,000 km away: the whole model has no Cholesky factor in double precision."""
    A, _, X, Y = exact_and_truth()
    A[:, 0, 3] += 1e8
    noise = 1e-3 * np.random.default_rng(4).normal(size=(len(A), 6))
    problem = rw.Problem()
    problem.add("board", "camera", A, np.linalg.inv(Y) @ A @ X @ se3.expmap(noise))
    calibration = rw.calibrate(problem, rw.CalibrateOptions(misreadings=False))
    assert calibration.noise.has_failed
    assert calibration.noise.model is None
    assert "could not be computed" in choice(calibration, "noise").evidence
    assert rw.Ground.COVARIANCE_DOUBTED in calibration.judgement.grounds
    assert calibration.verdict is not rw.Verdict.USE


def test_three_stations_are_too_few_for_a_covariance_that_is_relied_on() -> None:
    chance = np.random.default_rng(0)
    A = se3.expmap(np.hstack([0.7 * chance.normal(size=(3, 3)), 0.3 * chance.normal(size=(3, 3))]))
    X, Y = se3.expmap(np.array([[0.3, 0.1, -0.2, 0.1, 0.0, 0.2], [1.0, 0.3, -0.5, 0.5, 0.4, 0.6]]))
    problem = rw.Problem()
    problem.add("board", "camera", A, np.linalg.inv(Y) @ A @ X @ se3.expmap(0.001 * chance.normal(size=(3, 6))))
    calibration = rw.calibrate(problem)
    assert calibration.verdict is not rw.Verdict.USE
    assert "3 measurements are too few to tell how large their noise is" in calibration.verdict_reason
    raw, given = problem.measurements("board", "camera"), rw.Problem()
    given.add("board", "camera", raw.A, raw.B, sigma=0.001, kappa=5e5)
    assert "too few" not in rw.calibrate(given, rw.CalibrateOptions(noise="given")).verdict_reason


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
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", rw.errors.WeightsWarning)
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
    A = se3.expmap(np.hstack([0.6 * chance.normal(size=(6, 3)), 0.3 * chance.normal(size=(6, 3))]))
    X, Y = se3.expmap(np.array([[0.3, 0.1, -0.2, 0.1, 0.0, 0.2], [1.0, 0.3, -0.5, 0.5, 0.4, 0.6]]))
    B = np.linalg.inv(Y) @ A @ X @ se3.expmap(5e-3 * chance.normal(size=(6, 6)))
    problem = rw.Problem()
    problem.add("board", "camera", A, B, 5e-3 / 3.0, 0.5 / (5e-3 / 3.0) ** 2)
    calibration = rw.calibrate(problem, rw.CalibrateOptions(noise="given"))
    assert calibration.judgement.grounds == (rw.Ground.NOISE_UNDERSTATED,)
    assert calibration.outliers.number == 0
