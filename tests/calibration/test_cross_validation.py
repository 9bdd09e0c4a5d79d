"""Cross-validation: hold-out errors, folds, and notes."""

from __future__ import annotations

import io
from typing import Any

import numpy as np
import pytest
from rich.console import Console
from rwhec_factors.se3 import inverse

import gtsam_rwhec as rw
from gtsam_rwhec.calibration.cross_validation import PredictionError, cross_validate
from gtsam_rwhec.errors import CountError, MeasurementsNotKeptError, OptionError, UnderdeterminedError
from gtsam_rwhec.problem.selection import selected
from gtsam_rwhec.report.calibration_report import print_cross_validation
from gtsam_rwhec.simulate import Noise, general

NOISE = Noise(sigma_m=0.005, kappa=3000.0)
PAIR = ("target0", "sensor0")


def rebuilt(problem: rw.Problem, change: Any) -> rw.Problem:
    """The problem with each pair's (A, B, stamps) changed."""
    result = rw.Problem(problem.scale)
    for pair in problem.pairs:
        raw = problem.measurements(*pair)
        A, B, stamps = change(pair, raw.A.copy(), raw.B.copy(), raw.stamps_ns)
        result.add(*pair, A, B, 0.005, 3000.0, stamps_ns=stamps)
    return result


def printed(result: rw.CrossValidation, width: int = 80, *, pairs: bool = False) -> str:
    stream = io.StringIO()
    print_cross_validation(result, Console(file=stream, width=width, color_system=None), pairs=pairs)
    return stream.getvalue()


def test_errors_are_of_held_out_measurements() -> None:
    """Against five calibrations and predictions written out by hand."""
    problem = general(2, 2, seed=0, number_of_measurements=23, noise=NOISE, scale="shared").problem
    result = rw.cross_validate(problem, folds=5)
    assert (result.by, result.number_of_folds, result.ordered_by) == ("time", 5, "stamps")
    block = [int((i + 0.5) * 5 / 23) for i in range(23)]
    assert {block.count(fold) for fold in range(5)} == {4, 5}
    for fold in range(5):
        keep = {pair: np.array([b != fold for b in block]) for pair in problem.pairs}
        solution = rw.solve(selected(problem, keep))
        for target, sensor in problem.pairs:
            raw = problem.measurements(target, sensor)
            for i in np.flatnonzero(~keep[target, sensor]):
                Y, X = solution.Y[sensor].matrix(), solution.X[target].matrix()
                predicted = inverse(Y[None])[0] @ raw.A[i] @ X
                distance = np.linalg.norm(predicted[:3, 3] - raw.B[i, :3, 3] / solution.scale)
                cosine = (np.trace(predicted[:3, :3].T @ raw.B[i, :3, :3]) - 1.0) / 2.0
                assert result.translation_errors_m[target, sensor][i] == pytest.approx(distance, rel=1e-6)
                assert result.rotation_errors_rad[target, sensor][i] == pytest.approx(np.arccos(cosine), rel=1e-4)
    every = np.concatenate(list(result.translation_errors_m.values()))
    held = result.overall.held_out
    assert held.count == 92
    assert held.translation_rms_mm == pytest.approx(1e3 * np.sqrt(np.mean(every**2)))
    assert held.translation_median_mm == pytest.approx(1e3 * np.median(every))
    assert held.translation_95_mm == pytest.approx(1e3 * np.percentile(every, 95))
    assert result.overall.training.count == 92
    assert result.overall.not_predicted == 0
    own = np.concatenate([result.rotation_errors_rad[pair] for pair in problem.pairs if pair[1] == "sensor1"])
    assert result.sensors["sensor1"].held_out.rotation_rms_deg == pytest.approx(np.degrees(np.sqrt(np.mean(own**2))))
    assert result.targets["target1"].held_out.count == 46
    assert result.pairs[PAIR].held_out.count == 23
    assert not result.notes


@pytest.mark.parametrize("scale", ["known", "shared", "per_target"])
@pytest.mark.parametrize("by", ["time", "pair", "sensor"])
def test_with_much_data_the_error_is_the_noise(scale: Any, by: Any) -> None:
    true_scale = None if scale == "known" else {"target0": 2.0, "target1": 2.0} if scale == "per_target" else 2.0
    problem = general(2, 2, seed=1, number_of_measurements=60, noise=NOISE, scale=scale, true_scale=true_scale).problem
    held = cross_validate(problem, by=by).overall.held_out
    true_sigma_mm = 5.0 if scale == "known" else 2.5  # B's noise is on twice the length
    # In the inverse form, which a scale for each target needs, rotation noise acts on the lever arm (design fact 7).
    slack = 3.0 if scale == "per_target" else 1.15
    assert np.sqrt(3.0) * true_sigma_mm * 0.9 < held.translation_rms_mm < np.sqrt(3.0) * true_sigma_mm * slack
    assert held.rotation_rms_deg == pytest.approx(np.degrees(np.sqrt(3.0 / 6000.0)), rel=0.15)


def test_overfitting_makes_hold_out_errors_larger() -> None:
    """Four measurements: training errors are too small, hold-out errors are not."""
    problem = general(1, 1, seed=2, number_of_measurements=4, noise=NOISE).problem
    result = cross_validate(problem, folds=4)
    assert result.overall.held_out.translation_rms_mm > 1.3 * result.overall.training.translation_rms_mm
    many = cross_validate(general(1, 1, seed=2, number_of_measurements=200, noise=NOISE).problem).overall
    assert many.held_out.translation_rms_mm < 1.1 * many.training.translation_rms_mm


def test_an_outlier_is_in_the_rms_and_a_wrong_pair_stands_out() -> None:
    base = general(3, 3, seed=3, number_of_measurements=20, noise=NOISE).problem

    def spoil(pair: Any, A: Any, B: Any, stamps: Any) -> Any:
        if pair == PAIR:
            B[7, :3, 3] += 1.0
        if pair == ("target2", "sensor1"):  # seen with wrong intrinsics: always 5 % too far away
            B[:, :3, 3] *= 1.05
        return A, B, stamps

    result = cross_validate(rebuilt(base, spoil))
    assert np.nanargmax(result.translation_errors_m[PAIR]) == 7
    first = result.pairs[PAIR].held_out
    assert first.translation_rms_mm > 5.0 * first.translation_median_mm
    apart = cross_validate(rebuilt(base, spoil), by="pair")
    medians = {pair: comparison.held_out.translation_median_mm for pair, comparison in apart.pairs.items()}
    assert max(medians, key=medians.__getitem__) == ("target2", "sensor1")
    robust = cross_validate(rebuilt(base, spoil), options=rw.RefineOptions(robust="gnc"))
    assert robust.pairs[PAIR].held_out.translation_median_mm < first.translation_median_mm
    assert robust.overall.held_out.translation_median_mm <= result.overall.held_out.translation_median_mm


def test_blocks_are_contiguous_in_time_whatever_the_order_of_adding() -> None:
    base = general(2, 1, seed=4, number_of_measurements=30, noise=NOISE).problem
    order = np.random.default_rng(0).permutation(30)
    mixed = rw.Problem(base.scale)
    for pair in base.pairs:
        raw = base.measurements(*pair)
        for i in order:
            mixed.add(*pair, raw.A[[i]], raw.B[[i]], 0.005, 3000.0, stamps_ns=raw.stamps_ns[[i]])
    unstamped = rebuilt(base, lambda pair, A, B, stamps: (A, B, None))
    ours, others = cross_validate(base), cross_validate(mixed)
    for pair, errors in ours.translation_errors_m.items():
        np.testing.assert_allclose(others.translation_errors_m[pair], errors[order], rtol=1e-6)
    without = cross_validate(unstamped)
    assert without.ordered_by == "order"
    assert without.overall.held_out.translation_rms_mm == pytest.approx(ours.overall.held_out.translation_rms_mm)
    assert "the order in which they were added" in printed(without)


def test_drift_is_not_predicted_by_neighbours() -> None:
    """Errors that change slowly: folds at random would hide them."""
    base = general(1, 1, seed=5, number_of_measurements=100, noise=NOISE).problem

    def drift(pair: Any, A: Any, B: Any, stamps: Any) -> Any:
        B[:, :3, 3] += np.linspace(-0.2, 0.2, 100)[:, None] * np.array([0.0, 0.0, 1.0])
        return A, B, stamps

    drifting = cross_validate(rebuilt(base, drift)).overall
    assert drifting.held_out.translation_rms_mm > 1.05 * drifting.training.translation_rms_mm


def test_frames_that_no_other_measurement_determines_are_named() -> None:
    problem = general(
        3, 2, seed=6, graph=[(0, 0), (1, 0), (0, 1), (2, 1)], number_of_measurements=15, noise=NOISE
    ).problem
    result = cross_validate(problem, by="pair")
    assert result.number_of_folds == 4
    assert result.pairs["target1", "sensor0"].not_predicted == 15
    assert np.isnan(result.pairs["target1", "sensor0"].held_out.translation_rms_mm)
    assert result.pairs["target1", "sensor0"].training.count == 0
    assert any("target1-sensor0" in note and "no other measurement determines target1" in note for note in result.notes)
    # Held out, target0-sensor0 leaves two unconnected parts; both frames are known on their carriers all the same.
    assert result.pairs[PAIR].not_predicted == 0
    assert result.overall.held_out.count == 30
    assert "30 of 60" in printed(result)
    with pytest.raises(UnderdeterminedError, match="no measurement is left to predict it from"):
        cross_validate(general(1, 1, seed=0, noise=NOISE).problem, by="pair")


def test_fixed_frames_scales_and_motions() -> None:
    simulation = general(
        2, 1, seed=7, number_of_measurements=12, noise=NOISE, scale="per_target", odometry=12, odometry_noise=NOISE
    )
    problem = simulation.problem
    problem.fix_scale("target1", simulation.scale["target1"])  # type: ignore[index]
    problem.fix("target1", simulation.X["target1"])
    result = cross_validate(problem, by="pair")
    assert result.pairs["target1", "sensor0"].not_predicted == 0  # all of it is known beforehand
    assert result.pairs["target0", "sensor0"].not_predicted == 12
    assert result.pairs["sensor0", "sensor0"].not_predicted == 12
    assert any("the size of sensor0" in note for note in result.notes)
    by_sensor = cross_validate(problem, by="sensor")
    assert by_sensor.number_of_folds == 2
    assert by_sensor.sensors["sensor0"].held_out.count == 36
    assert set(by_sensor.targets) == {"target0", "target1"}


def test_few_measurements_of_a_pair_are_spread_over_the_folds() -> None:
    counts = {("target0", "sensor0"): 20, ("target1", "sensor0"): 2}
    problem = general(2, 1, seed=8, number_of_measurements=counts, noise=NOISE).problem
    result = cross_validate(problem, folds=5)
    assert result.overall.held_out.count == 22
    with pytest.raises(CountError, match="give at most 20"):
        cross_validate(problem, folds=21)


def test_bad_input_is_refused() -> None:
    problem = general(1, 1, seed=0, noise=NOISE).problem
    for folds in (1, 0, 2.5, True):
        with pytest.raises(OptionError, match="folds="):
            cross_validate(problem, folds=folds)  # type: ignore[arg-type]
    with pytest.raises(OptionError, match="by='target'"):
        cross_validate(problem, by="target")  # type: ignore[arg-type]
    with pytest.raises(MeasurementsNotKeptError, match="keep_measurements=True"):
        cross_validate(general(1, 1, seed=0, noise=NOISE, keep_measurements=False).problem)
    with pytest.raises(CountError, match="empty"):
        cross_validate(rw.Problem())


@pytest.mark.filterwarnings("error")
def test_warnings_of_a_folds_calibration_are_notes() -> None:
    problem = general(1, 1, seed=9, motion="planar", number_of_measurements=20, noise=NOISE).problem
    result = cross_validate(problem, folds=2)
    assert any(note.startswith("without block 1 of 2: the measurements do not determine") for note in result.notes)


@pytest.mark.parametrize("width", [40, 80, 120])
def test_the_table_says_everything(width: int) -> None:
    problem = general(3, 2, seed=10, number_of_measurements=15, noise=NOISE).problem
    result = cross_validate(problem, folds=3)
    text = printed(result, width, pairs=True)
    assert "…" not in text
    words = " ".join(text.split())
    assert "3 blocks, contiguous in time, by their stamps" in words
    for name, comparison in (result.sensors | result.targets).items():
        assert name in words
        assert f"{comparison.held_out.translation_rms_mm:.1f}" in words
        assert f"{comparison.training.rotation_rms_deg:.2f}" in words
    assert "target2-sensor1" in words
    assert "target2-sensor1" not in printed(result, width)
    tables = [line for line in text.splitlines() if line.startswith((" target", " sensor", " all"))]
    assert max((len(line) for line in tables), default=0) <= width


def test_percentiles_of_nothing() -> None:
    nothing = PredictionError.of(np.full(3, np.nan), np.full(3, np.nan))
    assert nothing.count == 0
    assert np.isnan(nothing.rotation_95_deg)


def test_refined_with_a_delay_predicts_with_the_delay() -> None:
    pytest.importorskip("rwhec_factors.batch")
    steps = np.arange(80) * 20_000_000
    t = steps * 1e-9

    def poses(at: np.ndarray) -> np.ndarray:
        import gtsam

        return np.array(
            [
                gtsam.Pose3(
                    gtsam.Rot3.RzRyRx(np.sin(3.0 * s), np.cos(2.3 * s), np.sin(1.7 * s + 1.0)),
                    np.array([np.sin(2.0 * s), np.cos(3.1 * s), np.sin(2.7 * s)]),
                ).matrix()
                for s in at
            ]
        )

    X, Y = (np.eye(4) for _ in range(2))
    X[:3, 3], Y[:3, 3] = [1.0, 0.5, 0.2], [0.1, 0.0, -0.2]
    late = inverse(Y[None]) @ poses(t + 0.004) @ X
    problem = rw.Problem()
    problem.add("tag", "camera", poses(t), late, 0.001, 1e5, stamps_ns=steps)
    plain = cross_validate(problem).overall.held_out
    offset = cross_validate(problem, options=rw.RefineOptions(time_offsets=True)).overall.held_out
    assert offset.translation_rms_mm < 0.2 * plain.translation_rms_mm
