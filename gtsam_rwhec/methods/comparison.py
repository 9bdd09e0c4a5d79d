"""The answers of all methods that can solve a problem: cost, residuals, time, and distance from the lower bound."""

from __future__ import annotations

import math
import time
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace

import gtsam
import numpy as np

from gtsam_rwhec.errors import FrameError, OptionError, RwhecError
from gtsam_rwhec.files.progress import Progress, check_progress
from gtsam_rwhec.files.terminal_text import brief
from gtsam_rwhec.geometry.blas_threads import one_blas_thread
from gtsam_rwhec.methods import certified
from gtsam_rwhec.methods.applicability import check_problem, refusal
from gtsam_rwhec.methods.chained import Chained, PairSolver, chained, solver_of, undetermined_pairs
from gtsam_rwhec.methods.estimate import Estimate
from gtsam_rwhec.methods.method import Method, MethodOptions, Takes, check_options
from gtsam_rwhec.methods.registry import METHODS, estimate_of, method_of, run
from gtsam_rwhec.problem.measurements import Pair
from gtsam_rwhec.problem.problem import Problem
from gtsam_rwhec.solver.certificate import Certificate
from gtsam_rwhec.solver.solution import Solution


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
    """All methods' answers.

    Attributes
    ----------
    rows : tuple of Compared
        Methods with an answer first, by increasing cost.
    solution : Solution or None
        The certified solution; its certificate's bound holds for every answer.
    error : RwhecError or None
        Why there is no certified solution.
    chained : tuple of Chained
        Methods for one pair on each pair of the best tree, cheapest first; none where the problem has one pair, an
        unknown scale, priors or fixed frames.
    undetermined : tuple of Pair
        Pairs that no tree takes, since their own measurements do not determine their frames.
    """

    rows: tuple[Compared, ...]
    solution: Solution | None
    error: RwhecError | None = None
    chained: tuple[Chained, ...] = ()
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
    pair_solvers: Mapping[str, PairSolver] | None = None,
    progress: Progress | None = None,
) -> Comparison:
    """Solve a problem by every method that can solve it, and by those for one pair on each pair of the best tree.

    Parameters
    ----------
    problem : Problem
    options : MethodOptions, optional
        The same for all methods.
    methods : iterable of str, optional
        Names; all methods if left out. The certified method always runs, for its bound.
    pair_solvers : mapping of str to callable, optional
        Other methods for one pair, to be chained too: ``gtsam_rwhec.handeye.PAIR_SOLVERS``.
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
    check_options(options)
    check_progress(progress)
    chosen = dict.fromkeys(method_of(name) for name in (METHODS if methods is None else methods))
    options = options or MethodOptions()
    check_problem(certified.METHOD, problem)
    if progress is not None:
        progress("certified")
    start = time.perf_counter()
    solution, error = None, None
    try:
        solution = certified.quiet_solution(problem, options)
    except RwhecError as raised:
        error = raised
    seconds = time.perf_counter() - start
    rows = [_compared(method, problem, options, progress) for method in chosen if method is not certified.METHOD]
    if certified.METHOD in chosen:
        estimate = None
        if solution is not None:
            estimate = estimate_of("certified", problem, certified.outcome_of(solution), seconds)
        rows.append(Compared(certified.METHOD, estimate, error))
    rows.sort(key=lambda row: math.inf if row.estimate is None else row.estimate.cost)
    trees, undetermined = _chained(problem, solution, rows, options, pair_solvers or {}, progress)
    return Comparison(tuple(rows), solution, error, trees, undetermined)


def _chained(
    problem: Problem,
    solution: Solution | None,
    rows: list[Compared],
    options: MethodOptions,
    others: Mapping[str, PairSolver],
    progress: Progress | None,
) -> tuple[tuple[Chained, ...], tuple[Pair, ...]]:
    """The methods that take one pair only, and ``others``, on the pairs of the best tree; and pairs that it avoids."""
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
