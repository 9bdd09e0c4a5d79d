"""Hold-out error: how well a calibration predicts measurements that it has not seen, in mm and degrees.

Residuals flatter: what was fitted has bent towards its own noise, and a wrong sigma or an outlier hides in a sum. Here
a part is held out, the rest calibrated, and the part predicted: B = Y^-1 A X against what was measured.
"""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np

from gtsam_rwhec.calibration.folds import Fold, Split, folds_of
from gtsam_rwhec.calibration.prediction_errors import HoldOutError, PredictionError, prediction_errors
from gtsam_rwhec.errors import (
    CountError,
    OptionError,
    OutlierError,
    RwhecWarning,
    ScaleError,
    UnderdeterminedError,
)
from gtsam_rwhec.files.progress import Progress, silent
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.problem.measurements import Measurements
from gtsam_rwhec.problem.pairs import Pair
from gtsam_rwhec.problem.problem import Problem
from gtsam_rwhec.problem.selection import selected
from gtsam_rwhec.refinement.options import RefineOptions
from gtsam_rwhec.refinement.refined import Refined
from gtsam_rwhec.refinement.refining import refine
from gtsam_rwhec.solver.options import SolveOptions
from gtsam_rwhec.solving.certified_solution import solve
from gtsam_rwhec.solving.solution import Solution


@dataclass(frozen=True)
class CrossValidation:
    """What ``cross_validate`` found.

    Attributes
    ----------
    by : "time", "pair" or "sensor"
    number_of_folds : int
    ordered_by : "stamps" or "order"
        What time was: stamps, or, for pairs without them, the order in which measurements were added.
    overall : HoldOutError
    sensors, targets : dict of str to HoldOutError
        A sensor's includes its own motions.
    pairs : dict of (target, sensor) to HoldOutError
    translation_errors_m, rotation_errors_rad : dict of (target, sensor) to (N,) array
        Held out, one by one, in the order of ``problem.measurements``; nan where not predicted.
    notes : tuple of str
        What could not be predicted and why, and what calibrating the rest warned of.
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
        With its raw measurements.
    folds : int
        With ``by="time"``: into how many blocks each pair is cut. A block is contiguous in time (by stamps; by the
        order of adding for pairs without), since neighbours share their errors: blind to that, folds drawn at random
        would be predicted by their own neighbours.
    by : "time", "pair" or "sensor"
        "pair": each pair is predicted from all others, as far as these measure both its frames: whether the graph
        agrees with itself. "sensor": one half in time of all that a sensor saw is predicted from its other half and
        from what the other sensors saw.
    options : RefineOptions, optional
        Refine each calibration with them; left out, it is the certified solution.
    solve_options : SolveOptions, optional
    progress : callable, optional
        Told each fold.

    Returns
    -------
    CrossValidation
        ``report.print_cross_validation`` prints it. Outliers are predicted too: they are in the root mean squares and
        the percentiles, not in the medians.

    Raises
    ------
    MeasurementsNotKeptError
        When the problem was made with ``keep_measurements=False``.
    CountError
        For more folds than any pair has measurements.
    OptionError
        For folds or a split that cannot be meant.
    UnderdeterminedError
        When nothing can be predicted from the rest.
    """
    _check(problem, folds, by)
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
            f"nothing can be predicted with by={by!r}: " + "; ".join(notes) + ". Measure more, or choose another split"
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
    if by not in get_args(Split):
        raise OptionError(f"by={by!r} is not one of {', '.join(map(repr, get_args(Split)))}")
    if not (isinstance(folds, int) and not isinstance(folds, bool) and folds >= 2):
        raise OptionError(f"folds={folds!r}; give a number of at least 2")
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
    options: RefineOptions | None
    solve_options: SolveOptions | None

    def __call__(self, problem: Problem, name: str, notes: dict[str, None]) -> Solution | Refined:
        """Solve, and refine if asked to; warnings become notes."""
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
    """Calibrate without the fold and fill in its errors."""
    name, held_out = fold
    if all(held_out[pair].all() if pair in held_out else False for pair in raw):
        notes.setdefault(f"{name}: nothing is left to predict it from")
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
            unknown = [frame for frame in pair.frames if not _is_known(problem, answer, frame)]
            lacking = " and ".join(unknown) if unknown else f"the size of {pair.target}"
            notes.setdefault(f"{pair} ({name}) is not predicted: nothing else measures {lacking}")


def _is_known(problem: Problem, answer: Solution | Refined, frame: str) -> bool:
    return frame in answer.X or frame in answer.Y or frame in problem.fixed
