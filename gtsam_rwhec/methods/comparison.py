"""The answers of all methods that can solve a problem: cost, residuals, time, and distance from the lower bound.

Methods for one pair are chained on a problem of many, as people do by hand: each pair of the best tree is solved alone.
The tree has the pairs with the most measurements (a maximum spanning tree, by Prim's algorithm), without those whose
own measurements do not determine their frames. A frame gets its pose from the pair by which the tree
reaches it. The measurements of all other pairs are not used: the comparison shows what the joint answer gains.
"""

from __future__ import annotations

import dataclasses
import json
import math
import time
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import gtsam
import numpy as np
from rwhec_factors import se3

from gtsam_rwhec.errors import FrameError, OptionError, RwhecError
from gtsam_rwhec.files.progress import Progress, check_progress
from gtsam_rwhec.files.terminal_text import brief
from gtsam_rwhec.files.whole_files import write_atomically
from gtsam_rwhec.geometry.blas_threads import one_blas_thread
from gtsam_rwhec.geometry.poses import Array, PoseLike, one_transform
from gtsam_rwhec.geometry.real_numbers import finite_or_none
from gtsam_rwhec.methods.certified import CERTIFIED, outcome_of, quiet_solution
from gtsam_rwhec.methods.hand_eye import solve_hand_eye
from gtsam_rwhec.methods.method import (
    Estimate,
    Method,
    MethodOptions,
    Outcome,
    Takes,
    check_problem,
    checked_options,
    refusal,
)
from gtsam_rwhec.methods.registry import METHODS, estimate_of, method_of, run
from gtsam_rwhec.problem.measurements import Pair
from gtsam_rwhec.problem.problem import Problem
from gtsam_rwhec.results.schema import CONVENTIONS, SENSOR_CARRIER, TARGET_CARRIER, pose_rows
from gtsam_rwhec.solver.certificate import Certificate
from gtsam_rwhec.solver.solution import Solution

#: X and Y of the one pair of a problem, metres.
PairSolver = Callable[[Problem], tuple[PoseLike, PoseLike]]
Poses = dict[str, gtsam.Pose3]


@dataclass(frozen=True)
class Chained:
    """A method for one pair, on every pair of a tree."""

    method: str  #: The method's name
    tree: tuple[Pair, ...]  #: The pairs whose answers count, in the order in which the tree took them
    #: The frames that the tree reaches
    X: Poses
    Y: Poses
    failed: dict[Pair, str]  #: Pairs that the tree avoids because the method has no answer for them, with the reason
    unreached: tuple[str, ...]  #: Frames that are in no pair that the tree can take
    estimate: Estimate[Poses] | None  #: The answer under the joint objective; None where frames are unreached
    #: The largest difference of a reached frame from the joint answer; nan without a frame
    off_mm: float
    off_deg: float


def undetermined_pairs(problem: Problem, solution: Solution) -> tuple[Pair, ...]:
    """The pairs whose own measurements do not determine their frames; they are in no tree."""
    alone = solution.identifiability.pairs
    return tuple(pair for pair in problem.pairs if not pair.is_motion and not alone[pair].is_unique)


def solver_of(method: Method[[Problem, MethodOptions]], options: MethodOptions) -> PairSolver:
    """A method for A X = Y B as a solver of one pair; it raises what the method raises, or its refusal."""

    def solved(problem: Problem) -> tuple[PoseLike, PoseLike]:
        error = refusal(method, problem)
        if error is not None:
            raise error
        found = method.function(problem, options)
        (pair,) = problem.pairs
        return found.X[pair.target], found.Y[pair.sensor]

    return solved


def solved_pair(problem: Problem, method: str) -> tuple[Array, Array]:
    """X and Y (4, 4) of the one pair of a problem, metres; raises what ``solve_hand_eye`` raises.

    Two consecutive measurements A_i X = Y B_i give C X = X H with C = A_j^-1 A_i and H = B_j^-1 B_i.
    """
    (pair,) = problem.pairs
    raw = problem.measurements(*pair)
    C = np.linalg.inv(raw.A[1:]) @ raw.A[:-1]
    H = np.linalg.inv(raw.B[1:]) @ raw.B[:-1]
    X = solve_hand_eye(C, H, method).X.matrix()
    Ys = raw.A @ X @ np.linalg.inv(raw.B)
    return X, se3.pose(se3.so3_nearest(Ys[:, :3, :3].sum(axis=0)), Ys[:, :3, 3].mean(axis=0))


#: Solvers of one pair by A X = X B, by their names in comparisons.
PAIR_SOLVERS: dict[str, PairSolver] = {
    f"AX=XB {name}": partial(solved_pair, method=name) for name in ("dan", "dqopt", "dqnlopt")
}


def chained(name: str, solver: PairSolver, problem: Problem, solution: Solution) -> Chained:
    """Solve the pairs of the best tree by a method for one pair.

    Parameters
    ----------
    name : str
        The method's name.
    solver : callable
        Solves a problem of one pair.
    problem : Problem
        Of known scale, with raw measurements, without priors.
    solution : Solution
        The joint answer: it shows which pairs are determined alone, and differences are relative to it.
    """
    start = time.perf_counter()
    avoided = set(undetermined_pairs(problem, solution))
    candidates = [pair for pair in problem.pairs if not pair.is_motion and pair not in avoided]
    candidates.sort(key=lambda pair: problem.moments(*pair).count, reverse=True)  # stable: the first of equals
    X: Poses = {}
    Y: Poses = {}
    tree: list[Pair] = []
    failed: dict[Pair, str] = {}
    while (pair := _next(candidates, X, Y)) is not None:
        candidates.remove(pair)
        try:
            of_pair = problem.with_measurements({pair: problem.measurements(*pair)})
            found_X, found_Y = solver(of_pair)
        except (RwhecError, np.linalg.LinAlgError) as error:
            failed[pair] = str(error)
            continue
        tree.append(pair)
        X.setdefault(pair.target, gtsam.Pose3(one_transform(found_X, pair.target)))
        Y.setdefault(pair.sensor, gtsam.Pose3(one_transform(found_Y, pair.sensor)))
    seconds = time.perf_counter() - start
    unreached = tuple(name for name in (*problem.targets, *problem.sensors) if name not in X and name not in Y)
    estimate = None if unreached else estimate_of(name, problem, Outcome(X, Y), seconds)
    differences = [solution.X[t].between(pose) for t, pose in X.items()]
    differences += [solution.Y[s].between(pose) for s, pose in Y.items()]
    off_m = [float(np.linalg.norm(T.translation())) for T in differences]
    off_rad = [float(np.linalg.norm(gtsam.Rot3.Logmap(T.rotation()))) for T in differences]
    return Chained(
        method=name,
        tree=tuple(tree),
        X=X,
        Y=Y,
        failed=failed,
        unreached=unreached,
        estimate=estimate,
        off_mm=1e3 * max(off_m, default=math.nan),
        off_deg=math.degrees(max(off_rad, default=math.nan)),
    )


def _next(candidates: list[Pair], X: Mapping[str, object], Y: Mapping[str, object]) -> Pair | None:
    """The heaviest pair from a frame of the tree to another; without one, the heaviest that begins another tree."""
    new = [pair for pair in candidates if (pair.target in X) + (pair.sensor in Y) < 2]
    touching = [pair for pair in new if pair.target in X or pair.sensor in Y]
    return next(iter(touching or new), None)


@dataclass(frozen=True)
class Compared:
    """One method with its estimate, or with the error for which it has no estimate."""

    method: Method[[Problem, MethodOptions]]
    estimate: Estimate[dict[str, gtsam.Pose3]] | None = None
    error: RwhecError | None = None

    @property
    def translation_rms_m(self) -> float:
        """Root mean square over all measurements, metres."""
        return self._pooled("translation_rms_m")

    @property
    def rotation_rms_rad(self) -> float:
        """Root mean square over all measurements, radians."""
        return self._pooled("rotation_rms_rad")

    def _pooled(self, rms: str) -> float:
        if self.estimate is None:
            return math.nan
        residuals = self.estimate.residuals.values()
        squares = sum(pair.number_of_measurements * getattr(pair, rms) ** 2 for pair in residuals)
        return math.sqrt(squares / sum(pair.number_of_measurements for pair in residuals))


@dataclass(frozen=True)
class Comparison:
    """All methods' answers."""

    rows: tuple[Compared, ...]  #: Methods with an answer first, by increasing cost
    solution: Solution | None  #: The certified solution; its certificate's bound holds for every answer
    error: RwhecError | None = None  #: Why there is no certified solution
    #: Methods for one pair on each pair of the best tree, cheapest first; none where the problem has one pair, an
    #: unknown scale, priors or fixed frames
    chained: tuple[Chained, ...] = ()
    #: Pairs that no tree takes, since their own measurements do not determine their frames
    undetermined: tuple[Pair, ...] = ()

    @property
    def certificate(self) -> Certificate | None:
        """The certificate whose lower bound holds for every answer's cost; None without a certified solution."""
        return None if self.solution is None else self.solution.certificate

    def gap(self, row: Compared) -> float | None:
        """The answer's cost above the lower bound; None without a bound or an answer."""
        if row.estimate is None or self.certificate is None or not math.isfinite(self.certificate.lower_bound):
            return None
        return max(0.0, row.estimate.cost - self.certificate.lower_bound)

    def is_optimal(self, row: Compared) -> bool:
        """Whether the answer is proven optimal under the certified objective."""
        gap = self.gap(row)
        return gap is not None and self.certificate is not None and gap <= self.certificate.tolerance


@one_blas_thread()
def compare(
    problem: Problem,
    options: MethodOptions | None = None,
    *,
    methods: Iterable[str] | None = None,
    progress: Progress | None = None,
) -> Comparison:
    """Solve a problem by every method that can solve it, and by those for one pair on each pair of the best tree.

    Parameters
    ----------
    options : MethodOptions, optional
        The same for all methods.
    methods : iterable of str, optional
        Keys of ``METHODS``, and of ``PAIR_SOLVERS`` for A X = X B, pair by pair; all if left out. The certified
        method always runs, for its bound.
    progress : callable, optional
        Called with each method's name when the method begins.

    Raises
    ------
    CountError, FrameError, UnderdeterminedError
        When no method can solve the problem.
    OptionError
        When a method's name is unknown.
    """
    if methods is not None and (isinstance(methods, str) or not np.iterable(methods)):
        raise OptionError(f"methods={brief(methods)}; give a list of names: ['shah2013']")
    options = checked_options(options)
    check_progress(progress)
    names = [*METHODS, *PAIR_SOLVERS] if methods is None else list(methods)
    of_motions = {name: PAIR_SOLVERS[name] for name in names if isinstance(name, str) and name in PAIR_SOLVERS}
    chosen = dict.fromkeys(method_of(name) for name in names if not (isinstance(name, str) and name in PAIR_SOLVERS))
    check_problem(CERTIFIED, problem)
    if progress is not None:
        progress("certified")
    start = time.perf_counter()
    solution, error = None, None
    try:
        solution = quiet_solution(problem, options)
    except RwhecError as raised:
        error = raised
    seconds = time.perf_counter() - start
    rows = [_compared(method, problem, options, progress) for method in chosen if method is not CERTIFIED]
    if CERTIFIED in chosen:
        estimate = None
        if solution is not None:
            estimate = estimate_of("certified", problem, outcome_of(solution), seconds)
        rows.append(Compared(CERTIFIED, estimate, error))
    rows.sort(key=lambda row: math.inf if row.estimate is None else row.estimate.cost)
    trees, undetermined = _chained(problem, solution, rows, options, of_motions, progress)
    return Comparison(tuple(rows), solution, error, trees, undetermined)


def _chained(
    problem: Problem,
    solution: Solution | None,
    rows: list[Compared],
    options: MethodOptions,
    others: Mapping[str, PairSolver],
    progress: Progress | None,
) -> tuple[tuple[Chained, ...], tuple[Pair, ...]]:
    """Methods for one pair only, and ``others``, on the pairs of the best tree; and the undetermined pairs."""
    has_knowledge = bool(problem.fixed or problem.priors) or problem.scale != "known"
    of_poses = [pair for pair in problem.pairs if not pair.is_motion]
    if solution is None or len(of_poses) < 2 or has_knowledge or not problem.keep_measurements:
        return (), ()
    solvers = {
        row.method.name: solver_of(row.method, replace(options, start=None))
        for row in rows
        if isinstance(row.error, FrameError) and Takes.CORNERS not in row.method.takes
    }
    found = []
    for name, solver in {**solvers, **others}.items():
        if progress is not None:
            progress(f"{name}, pair by pair")
        found.append(chained(name, solver, problem, solution))
    found.sort(key=lambda each: math.inf if each.estimate is None else each.estimate.cost)
    return tuple(found), undetermined_pairs(problem, solution)


def _compared(
    method: Method[[Problem, MethodOptions]], problem: Problem, options: MethodOptions, progress: Progress | None
) -> Compared:
    error = refusal(method, problem)
    if error is not None:
        return Compared(method, error=error)
    if progress is not None:
        progress(method.name)
    try:
        return Compared(method, run(method.name, problem, options))
    except RwhecError as raised:
        return Compared(method, error=raised)


FORMAT = "gtsam-rwhec comparison"
FORMAT_VERSION = 1


def comparison_fields(comparison: Comparison) -> dict[str, Any]:
    """The file's fields: the lower bound, and each method with its answer or the reason why it has no answer."""
    certificate = comparison.certificate
    return {
        "format": FORMAT,
        "format_version": FORMAT_VERSION,
        "conventions": {name: CONVENTIONS[name] for name in ("pose", "model", "scale", "units")},
        "objective": None if certificate is None else str(certificate.objective),
        "certificate": None if certificate is None else str(certificate),
        "no_certificate": None if comparison.error is None else str(comparison.error),
        "lower_bound": None if certificate is None else finite_or_none(certificate.lower_bound),
        "tolerance": None if certificate is None else certificate.tolerance,
        "methods": [_row(comparison, row) for row in comparison.rows],
        "chained": [_chained_row(row) for row in comparison.chained],
        "pairs_that_no_tree_takes": list(map(str, comparison.undetermined)),
    }


def write_comparison(comparison: Comparison, path: str | Path) -> None:
    """Write the JSON file.

    Raises
    ------
    FileFormatError
        The file cannot be written; the message says why.
    """
    content = json.dumps(comparison_fields(comparison), indent=2, allow_nan=False) + "\n"
    write_atomically(path, content.encode("utf-8"))


def _row(comparison: Comparison, row: Compared) -> dict[str, Any]:
    method, estimate = row.method, row.estimate
    fields: dict[str, Any] = {
        "method": method.name,
        "source": method.source,
        "assumes": method.assumes,
        "properties": dataclasses.asdict(method.properties),
        "reason": None if row.error is None else str(row.error),
    }
    if estimate is None:
        return fields | {"answer": None}
    return fields | {
        "answer": {
            "cost": estimate.cost,
            "gap": comparison.gap(row),
            "is_optimal": comparison.is_optimal(row),
            "translation_rms_m": finite_or_none(row.translation_rms_m),
            "rotation_rms_rad": finite_or_none(row.rotation_rms_rad),
            "seconds": estimate.seconds,
            "starts_from": estimate.starts_from,
            "notes": list(estimate.notes),
            "free_directions": [str(direction) for direction in estimate.free_directions],
            "scale": estimate.scale,
            "targets": pose_rows(TARGET_CARRIER, estimate.X),
            "sensors": pose_rows(SENSOR_CARRIER, estimate.Y),
        }
    }


def _chained_row(row: Chained) -> dict[str, Any]:
    return {
        "method": row.method,
        "tree": list(map(str, row.tree)),
        "failed": {str(pair): why for pair, why in row.failed.items()},
        "unreached": list(row.unreached),
        "cost": None if row.estimate is None else row.estimate.cost,
        "off_mm": finite_or_none(row.off_mm),
        "off_deg": finite_or_none(row.off_deg),
        "targets": pose_rows(TARGET_CARRIER, row.X),
        "sensors": pose_rows(SENSOR_CARRIER, row.Y),
    }
