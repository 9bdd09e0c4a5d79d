"""Cross-validation: the hold-out error of a calibration, in millimetres and degrees.

Residuals are too small, because the fitted answer follows its own noise, and their sum hides a wrong sigma or an
outlier. Here some measurements are held out, the rest is calibrated, and the calibration predicts the held-out
measurements: B = Y^-1 A X.
"""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np

from gtsam_rwhec.calibration.folds import Fold, Split, folds_of
from gtsam_rwhec.calibration.prediction_errors import HoldOutError, PredictionError, prediction_errors
from gtsam_rwhec.errors import CountError, OptionError, OutlierError, RwhecWarning, ScaleError, UnderdeterminedError
from gtsam_rwhec.files.progress import Progress, check_progress, silent
from gtsam_rwhec.files.terminal_text import brief
from gtsam_rwhec.fitting.fit_options import RefineOptions
from gtsam_rwhec.fitting.refined import Refined
from gtsam_rwhec.fitting.refinement_from_poses import refine
from gtsam_rwhec.geometry.blas_threads import one_blas_thread
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.geometry.real_numbers import is_one_of, is_whole
from gtsam_rwhec.problem.measurements import Measurements
from gtsam_rwhec.problem.pairs import Pair
from gtsam_rwhec.problem.problem import Problem
from gtsam_rwhec.problem.selection import selected
from gtsam_rwhec.solver.options import SolveOptions
from gtsam_rwhec.solving.certified_solution import solve
from gtsam_rwhec.solving.solution import Solution


@dataclass(frozen=True)
class CrossValidation:
    """The result of ``cross_validate``.

    Attributes
    ----------
    by : "time", "pair" or "sensor"
    number_of_folds : int
    ordered_by : "stamps" or "order"
        The time of measurements: their stamps, or, for pairs without stamps, the order in which they were added.
    overall : HoldOutError
    sensors, targets : dict of str to HoldOutError
        A sensor's error includes its own motions.
    pairs : dict of (target, sensor) to HoldOutError
    translation_errors_m, rotation_errors_rad : dict of (target, sensor) to (N,) array
        The error of each held-out measurement, in the order of ``problem.measurements``; nan where not predicted.
    notes : tuple of str
        The measurements that could not be predicted, with the reason, and the warnings of the calibrations.
    """

    by: Split
    number_of_folds: int
    ordered_by: Literal["stamps", "order"]
    overall: HoldOutError
    sensors: dict[str, HoldOutError]
    targets: dict[str, HoldOutError]
    pairs: dict[Pair, HoldOutError]
    translation_errors_m: dict[Pair, Array]
    rotation_errors_rad: dict[Pair, Array]
    notes: tuple[str, ...]


@one_blas_thread()
def cross_validate(
    problem: Problem,
    folds: int = 5,
    *,
    by: Split = "time",
    options: RefineOptions | None = None,
    solve_options: SolveOptions | None = None,
    progress: Progress | None = None,
) -> CrossValidation:
    """Predict measurements from a calibration that has not seen them.

    Parameters
    ----------
    problem : Problem
        A problem that kept its raw measurements.
    folds : int
        With ``by="time"``: the number of blocks into which each pair is cut. A block is contiguous in time (by stamps;
        without stamps by the order of adding). Neighbours in time share their errors, so random folds would be
        predicted from their own neighbours.
    by : "time", "pair" or "sensor"
        "pair": each pair is predicted from all other pairs, if these measure both its frames. This shows whether the
        graph agrees with itself. "sensor": one half in time of a sensor's measurements is predicted from its other half
        and from the other sensors.
    options : RefineOptions, optional
        Refine each calibration with these options. Without them it is the certified solution.
    solve_options : SolveOptions, optional
    progress : callable, optional
        Is called with the name of each fold.

    Returns
    -------
    CrossValidation
        ``report.print_cross_validation`` prints it. The errors of outliers are included: they raise the root mean
        squares and the percentiles, but change the medians little.

    Raises
    ------
    MeasurementsNotKeptError
        If the problem was made with ``keep_measurements=False``.
    CountError
        If there are more folds than measurements of any pair.
    OptionError
        If ``folds`` or ``by`` is not valid.
    UnderdeterminedError
        If no measurement can be predicted from the rest.
    """
    _check(problem, folds, by)
    check_progress(progress)
    raw = {pair: problem.measurements(*pair) for pair in problem.pairs}
    calibrate = _Calibrator(options, solve_options)
    notes: dict[str, None] = {}
    everything = calibrate(problem, "with everything", notes)
    training = {pair: prediction_errors(problem, everything, pair, one) for pair, one in raw.items()}
    errors = {pair: np.full((2, len(one.A)), np.nan) for pair, one in raw.items()}
    tell = progress or silent
    number = 0
    for fold in folds_of(raw, by, folds):
        number += 1
        tell(f"held out: {fold.name}")
        _predict(problem, raw, fold, calibrate, errors, notes)
    if not any(np.isfinite(values).any() for values in errors.values()):
        raise UnderdeterminedError(
            f"no measurement can be predicted with by={by!r}: {'; '.join(notes)}. Measure more, or choose another split"
        )

    def compare(pairs: list[Pair]) -> HoldOutError:
        held = np.concatenate([errors[pair] for pair in pairs], axis=1) if pairs else np.zeros((2, 0))
        seen = np.concatenate([training[pair] for pair in pairs], axis=1) if pairs else np.zeros((2, 0))
        return HoldOutError(
            PredictionError.of(*held),
            PredictionError.of(*np.where(np.isnan(held), np.nan, seen)),
            int(np.isnan(held[0]).sum()),
        )

    return CrossValidation(
        by=by,
        number_of_folds=number,
        ordered_by="stamps" if all(one.stamps_ns is not None for one in raw.values()) else "order",
        overall=compare(list(raw)),
        sensors={name: compare([pair for pair in raw if pair.sensor == name]) for name in problem.sensors},
        targets={name: compare([pair for pair in raw if pair.target == name]) for name in problem.targets},
        pairs={pair: compare([pair]) for pair in raw},
        translation_errors_m={pair: values[0] for pair, values in errors.items()},
        rotation_errors_rad={pair: values[1] for pair, values in errors.items()},
        notes=tuple(notes),
    )


def _check(problem: Problem, folds: int, by: str) -> None:
    if not isinstance(problem, Problem):
        raise OptionError(f"the problem is a {type(problem).__name__}; give a gtsam_rwhec.Problem")
    if not is_one_of(by, get_args(Split)):
        raise OptionError(f"by={brief(by)} is not one of {', '.join(map(repr, get_args(Split)))}")
    if not is_whole(folds, 2):
        raise OptionError(f"folds={brief(folds)}; give a whole number of at least 2")
    problem.require_pairs()
    problem.require_raw_measurements("cross_validate")
    largest = max(problem.moments(*pair).count for pair in problem.pairs)
    if by == "time" and folds > largest:
        raise CountError(
            f"folds={folds}, but no pair has more than {largest} measurements to cut into blocks; give at most "
            f"{largest}"
        )


@dataclass(frozen=True)
class _Calibrator:
    """Calibrates each fold's problem in the same way."""

    options: RefineOptions | None
    solve_options: SolveOptions | None

    def __call__(self, problem: Problem, name: str, notes: dict[str, None]) -> Solution | Refined:
        """The certified solution, refined if there are options; warnings become notes."""
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            solution = solve(problem, options=self.solve_options)
            answer = solution if self.options is None else refine(problem, solution, self.options)
        for warning in caught:
            if isinstance(warning.message, RwhecWarning):
                notes.setdefault(f"{name}: {warning.message}")
            else:
                warnings.warn_explicit(warning.message, warning.category, warning.filename, warning.lineno)
        return answer


def _predict(
    problem: Problem,
    raw: Mapping[Pair, Measurements],
    fold: Fold,
    calibrate: _Calibrator,
    errors: dict[Pair, Array],
    notes: dict[str, None],
) -> None:
    """Calibrate without the fold, and write its prediction errors into ``errors``."""
    name, held_out = fold
    if all(pair in held_out and held_out[pair].all() for pair in raw):
        notes.setdefault(f"{name}: no measurement is left to predict it from")
        return
    try:
        answer = calibrate(selected(problem, {pair: ~m for pair, m in held_out.items()}), f"without {name}", notes)
    except (UnderdeterminedError, ScaleError, OutlierError) as error:
        notes.setdefault(f"{name} is not predicted: the rest gives no answer ({error})")
        return
    for pair, mask in held_out.items():
        if not mask.any():
            continue
        predicted = prediction_errors(problem, answer, pair, raw[pair])
        errors[pair][:, mask] = predicted[:, mask]
        if np.isnan(predicted).all():
            known = set(answer.X) | set(answer.Y) | set(problem.fixed)
            unknown = [frame for frame in pair.frames if frame not in known]
            lacking = " and ".join(unknown) if unknown else f"the size of {pair.target}"
            notes.setdefault(f"{pair} ({name}) is not predicted: no other measurement determines {lacking}")
