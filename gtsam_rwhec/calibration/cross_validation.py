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

from gtsam_rwhec.errors import CountError, OptionError, OutlierError, RwhecWarning, ScaleError, UnderdeterminedError
from gtsam_rwhec.files.progress import Progress, check_progress, silent
from gtsam_rwhec.files.terminal_text import brief
from gtsam_rwhec.fitting.fit_options import RefineOptions
from gtsam_rwhec.fitting.refined import Refined, RefinedPoses
from gtsam_rwhec.fitting.refinement_from_poses import refine
from gtsam_rwhec.geometry.blas_threads import one_blas_thread
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.geometry.real_numbers import check_kind, is_one_of, is_whole
from gtsam_rwhec.geometry.trajectory import LocalPaths
from gtsam_rwhec.problem.measurements import Measurements, Pair
from gtsam_rwhec.problem.problem import Problem
from gtsam_rwhec.problem.selection import selected
from gtsam_rwhec.solver.solution import Solution, solve
from gtsam_rwhec.solver.solve_options import SolveOptions

Split = Literal["time", "pair", "sensor"]


#: Measurements that are held out together, as (N,) booleans for each pair that has some.
HeldOut = dict[Pair, np.ndarray]


def folds_of(raw: Mapping[Pair, Measurements], by: Split, number: int) -> dict[str, HeldOut]:
    """The folds of a split, by a name for messages; with ``by="time"`` there are ``number`` folds."""
    if by == "pair":
        return {pair.label: {pair: np.ones(len(one.A), dtype=bool)} for pair, one in raw.items()}
    rank = {pair: _in_time(one) for pair, one in raw.items()}
    if by == "time":
        # The middle of each measurement's share of the pair: few measurements are spread over all folds.
        block = {pair: ((of + 0.5) * number / len(of)).astype(np.int64) for pair, of in rank.items()}
        return {
            f"block {fold + 1} of {number}": {pair: of == fold for pair, of in block.items()} for fold in range(number)
        }
    folds: dict[str, HeldOut] = {}
    for sensor in dict.fromkeys(sensor for _, sensor in raw):
        own = {pair: 2 * of < len(of) for pair, of in rank.items() if pair.sensor == sensor}
        folds[f"{sensor}, first half"] = own
        folds[f"{sensor}, second half"] = {pair: ~mask for pair, mask in own.items()}
    return folds


def _in_time(one: Measurements) -> np.ndarray:
    """The rank (N,) of each measurement in time."""
    return np.arange(len(one.A)) if one.stamps_ns is None else np.argsort(np.argsort(one.stamps_ns, kind="stable"))


@dataclass(frozen=True)
class PredictionError:
    """The distance of predicted measurements from the measured ones."""

    count: int  #: Number of predicted measurements
    #: Root mean square, median and 95th percentile of |t_measured / scale - t_predicted|, true millimetres; nan if no
    #: measurement was predicted
    translation_rms_mm: float
    translation_median_mm: float
    translation_95_mm: float
    #: Root mean square, median and 95th percentile of the angle of R_measured' R_predicted, degrees
    rotation_rms_deg: float
    rotation_median_deg: float
    rotation_95_deg: float

    @staticmethod
    def of(translation_m: Array, rotation_rad: Array) -> PredictionError:
        """The statistics of single errors; nan marks a measurement that was not predicted."""
        known = np.isfinite(translation_m)
        mm, deg = 1e3 * translation_m[known], np.degrees(rotation_rad[known])
        return PredictionError(len(mm), *_rms_median_95(mm), *_rms_median_95(deg))


@dataclass(frozen=True)
class HoldOutError:
    """The errors of held-out measurements, and of the same measurements with a calibration from all measurements."""

    #: If the two differ much, there are too few measurements, or too many unknowns, for the noise. If both are large,
    #: there are outliers, a wrong model (intrinsics, a size, a delay), or much noise.
    held_out: PredictionError
    training: PredictionError
    not_predicted: int  #: Number of measurements of frames that the other measurements do not determine


def prediction_errors(problem: Problem, answer: Solution | RefinedPoses, pair: Pair, one: Measurements) -> Array:
    """The errors (2, N) of a pair's predicted measurements, in true metres and radians; nan if a pose is not known."""
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
    return float(np.sqrt(np.mean(values**2))), float(np.median(values)), float(np.percentile(values, 95.0))


@dataclass(frozen=True)
class CrossValidation:
    """The result of ``cross_validate``."""

    by: Split
    number_of_folds: int
    #: The time of measurements: their stamps, or, for pairs without stamps, the order in which they were added
    ordered_by: Literal["stamps", "order"]
    overall: HoldOutError
    #: The error of a sensor includes that of its own motions
    sensors: dict[str, HoldOutError]
    targets: dict[str, HoldOutError]
    pairs: dict[Pair, HoldOutError]
    #: The error of each held-out measurement, in the order of ``problem.measurements``; nan where not predicted.
    translation_errors_m: dict[Pair, Array]
    rotation_errors_rad: dict[Pair, Array]
    #: The measurements that could not be predicted, with the reason, and the warnings of the calibrations
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
    notes: dict[str, None] = {}

    def calibrated(some: Problem, name: str) -> Solution | Refined:
        with warnings.catch_warnings(record=True, action="always") as caught:
            solution = solve(some, options=solve_options)
            answer = solution if options is None else refine(some, solution, options)
        for warning in caught:
            if isinstance(warning.message, RwhecWarning):
                notes.setdefault(f"{name}: {warning.message}")
            else:
                warnings.warn_explicit(warning.message, warning.category, warning.filename, warning.lineno)
        return answer

    everything = calibrated(problem, "with everything")
    training = {pair: prediction_errors(problem, everything, pair, one) for pair, one in raw.items()}
    errors = {pair: np.full((2, len(one.A)), np.nan) for pair, one in raw.items()}
    split = folds_of(raw, by, folds)
    for name, held_out in split.items():
        (progress or silent)(f"held out: {name}")
        if all(pair in held_out and held_out[pair].all() for pair in raw):
            notes.setdefault(f"{name}: no measurement is left to predict it from")
            continue
        try:
            rest = selected(problem, {pair: ~mask for pair, mask in held_out.items()})
            answer = calibrated(rest, f"without {name}")
        except (UnderdeterminedError, ScaleError, OutlierError) as error:
            notes.setdefault(f"{name} is not predicted: the rest gives no answer ({error})")
            continue
        for pair, mask in held_out.items():
            if not mask.any():
                continue
            predicted = prediction_errors(problem, answer, pair, raw[pair])
            errors[pair][:, mask] = predicted[:, mask]
            if np.isnan(predicted).all():
                known = set(answer.X) | set(answer.Y) | set(problem.fixed)
                unknown = [frame for frame in pair.frames if frame not in known]
                lacking = " and ".join(unknown) or f"the size of {pair.target}"
                notes.setdefault(f"{pair} ({name}) is not predicted: no other measurement determines {lacking}")
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
        number_of_folds=len(split),
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
    check_kind(problem, Problem, "the problem", "a gtsam_rwhec.Problem")
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
