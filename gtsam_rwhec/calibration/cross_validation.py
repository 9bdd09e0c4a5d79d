"""Hold-out error: how well a calibration predicts measurements that it has not seen, in mm and degrees.

Residuals flatter: what was fitted has bent towards its own noise, and a wrong sigma or an outlier hides in a sum. Here
a part is held out, the rest calibrated, and the part predicted: B = Y^-1 A X against what was measured.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np

from gtsam_rwhec.errors import (
    CountError,
    MeasurementsNotKeptError,
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
from gtsam_rwhec.trajectories.local_paths import LocalPaths

Split = Literal["time", "pair", "sensor"]


@dataclass(frozen=True)
class PredictionError:
    """How far predicted measurements are from the measured ones.

    Attributes
    ----------
    count : int
        Measurements that were predicted.
    translation_rms_mm, translation_median_mm, translation_95_mm : float
        Root mean square, median and 95th percentile of |t_measured / scale - t_predicted|, true millimetres; nan where
        nothing was predicted.
    rotation_rms_deg, rotation_median_deg, rotation_95_deg : float
        The same of the angle of R_measured' R_predicted.
    """

    count: int
    translation_rms_mm: float
    translation_median_mm: float
    translation_95_mm: float
    rotation_rms_deg: float
    rotation_median_deg: float
    rotation_95_deg: float

    @staticmethod
    def of(translation_m: Array, rotation_rad: Array) -> PredictionError:
        """Of errors one by one; nan is what was not predicted."""
        known = np.isfinite(translation_m)
        mm, deg = 1e3 * translation_m[known], np.degrees(rotation_rad[known])
        return PredictionError(len(mm), *_rms_median_95(mm), *_rms_median_95(deg))


@dataclass(frozen=True)
class Comparison:
    """Measurements held out, and the same measurements when the calibration has seen all.

    Attributes
    ----------
    held_out, training : PredictionError
        Far apart: too few measurements, or too many unknowns, for the noise. Both large: outliers, a wrong model
        (intrinsics, a size, a delay), or much noise.
    not_predicted : int
        Measurements of frames that the rest does not measure.
    """

    held_out: PredictionError
    training: PredictionError
    not_predicted: int


@dataclass(frozen=True)
class CrossValidation:
    """What ``cross_validate`` found.

    Attributes
    ----------
    by : "time", "pair" or "sensor"
    number_of_folds : int
    ordered_by : "stamps" or "order"
        What time was: stamps, or, for pairs without them, the order in which measurements were added.
    overall : Comparison
    sensors, targets : dict of str to Comparison
        A sensor's includes its own motions.
    pairs : dict of (target, sensor) to Comparison
    translation_errors_m, rotation_errors_rad : dict of (target, sensor) to (N,) array
        Held out, one by one, in the order of ``problem.measurements``; nan where not predicted.
    notes : tuple of str
        What could not be predicted and why, and what calibrating the rest warned of.
    """

    by: Split
    number_of_folds: int
    ordered_by: Literal["stamps", "order"]
    overall: Comparison
    sensors: dict[str, Comparison]
    targets: dict[str, Comparison]
    pairs: dict[Pair, Comparison]
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
    training = {pair: _errors(problem, everything, pair, one) for pair, one in raw.items()}
    errors = {pair: np.full((2, len(one.A)), np.nan) for pair, one in raw.items()}
    folds_by = {"time": lambda: _blocks(raw, folds), "pair": lambda: _pairs(raw), "sensor": lambda: _halves(raw)}
    tell = progress or silent
    number = 0
    for name, held_out in folds_by[by]():
        number += 1
        tell(f"held out: {name}")
        _predict(problem, raw, name, held_out, calibrate, errors, notes)
    if not any(np.isfinite(values).any() for values in errors.values()):
        raise UnderdeterminedError(
            f"nothing can be predicted with by={by!r}: " + "; ".join(notes) + ". Measure more, or choose another split"
        )

    def compare(pairs: list[Pair]) -> Comparison:
        held = np.concatenate([errors[pair] for pair in pairs], axis=1) if pairs else np.zeros((2, 0))
        seen = np.concatenate([training[pair] for pair in pairs], axis=1) if pairs else np.zeros((2, 0))
        return Comparison(
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
    if not problem.pairs:
        raise CountError("the problem is empty: no measurements; add some with problem.add(target, sensor, A, B, ...)")
    if not problem.has_measurements:
        raise MeasurementsNotKeptError(
            "cross_validate calibrates without a part of the raw measurements, and they were not kept "
            "(keep_measurements=False); make the problem with keep_measurements=True"
        )
    largest = max(problem.moments(*pair).count for pair in problem.pairs)
    if by == "time" and folds > largest:
        raise CountError(
            f"folds={folds}, but no pair has more than {largest} measurements to cut into blocks; give at most "
            f"{largest}"
        )


# -- folds: what is held out, by name -------------------------------------------------------------------------------

Fold = tuple[str, dict[Pair, np.ndarray]]


def _in_time(one: Measurements) -> np.ndarray:
    """Rank of each measurement in time, (N,)."""
    count = len(one.A)
    if one.stamps_ns is None:
        return np.arange(count)
    rank = np.empty(count, dtype=np.int64)
    rank[np.argsort(one.stamps_ns, kind="stable")] = np.arange(count)
    return rank


def _blocks(raw: Mapping[Pair, Measurements], folds: int) -> Iterator[Fold]:
    # The middle of each measurement's share: pairs with fewer measurements than folds are spread over them.
    block = {pair: ((_in_time(one) + 0.5) * folds / len(one.A)).astype(np.int64) for pair, one in raw.items()}
    for fold in range(folds):
        yield f"block {fold + 1} of {folds}", {pair: number == fold for pair, number in block.items()}


def _pairs(raw: Mapping[Pair, Measurements]) -> Iterator[Fold]:
    for pair, one in raw.items():
        yield pair.label, {pair: np.ones(len(one.A), dtype=bool)}


def _halves(raw: Mapping[Pair, Measurements]) -> Iterator[Fold]:
    for sensor in dict.fromkeys(sensor for _, sensor in raw):
        own = {pair: 2 * _in_time(one) < len(one.A) for pair, one in raw.items() if pair.sensor == sensor}
        yield f"{sensor}, first half", own
        yield f"{sensor}, second half", {pair: ~mask for pair, mask in own.items()}


# -- calibrating and predicting -------------------------------------------------------------------------------------


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
    name: str,
    held_out: dict[Pair, np.ndarray],
    calibrate: _Calibrator,
    errors: dict[Pair, Array],
    notes: dict[str, None],
) -> None:
    """Calibrate without the fold and fill in its errors."""
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
        predicted = _errors(problem, answer, pair, raw[pair])
        errors[pair][:, mask] = predicted[:, mask]
        if np.isnan(predicted).all():
            unknown = [frame for frame in pair.frames if not _is_known(problem, answer, frame)]
            lacking = " and ".join(unknown) if unknown else f"the size of {pair.target}"
            notes.setdefault(f"{pair} ({name}) is not predicted: nothing else measures {lacking}")


def _is_known(problem: Problem, answer: Solution | Refined, frame: str) -> bool:
    return frame in answer.X or frame in answer.Y or frame in problem.fixed


def _errors(problem: Problem, answer: Solution | Refined, pair: Pair, one: Measurements) -> Array:
    """Of predictions of all of a pair's measurements, (2, N): in true metres and in radians; nan without a pose."""
    poses: dict[str, Array] = {name: pose.matrix() for name, pose in (answer.X | answer.Y).items()}
    poses = {**problem.fixed, **poses}
    scales = answer.scale
    scale = {**problem.fixed_scales, **scales}.get(pair.target) if isinstance(scales, Mapping) else scales
    if scale is None or any(name not in poses for name in pair):
        return np.full((2, len(one.A)), np.nan)
    A = one.A
    offset = getattr(answer, "time_offsets_s", {}).get(pair.sensor, 0.0)
    if offset and one.stamps_ns is not None:
        A = A @ LocalPaths.of(A, one.stamps_ns, pair.label).motion(offset)
    predicted = np.linalg.inv(poses[pair.sensor]) @ A @ poses[pair.target]
    translation = np.linalg.norm(one.B[:, :3, 3] / scale - predicted[:, :3, 3], axis=1)
    chord = np.linalg.norm(one.B[:, :3, :3] - predicted[:, :3, :3], axis=(1, 2))  # sqrt(8) sin(angle / 2)
    return np.stack([translation, 2.0 * np.arcsin(np.minimum(1.0, chord / np.sqrt(8.0)))])


def _rms_median_95(values: Array) -> tuple[float, float, float]:
    if len(values) == 0:
        return np.nan, np.nan, np.nan
    return (
        float(np.sqrt(np.mean(values**2))),
        float(np.median(values)),
        float(np.percentile(values, 95.0)),
    )
