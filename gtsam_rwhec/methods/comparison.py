"""All methods that apply to one problem, side by side: cost, residuals, time, and the distance from the bound."""

from __future__ import annotations

import math
import time
from collections.abc import Iterable
from dataclasses import dataclass

import gtsam

from gtsam_rwhec.errors import RwhecError
from gtsam_rwhec.files.progress import Progress
from gtsam_rwhec.methods import certified
from gtsam_rwhec.methods.applicability import check_problem, refusal
from gtsam_rwhec.methods.estimate import Estimate
from gtsam_rwhec.methods.method import Method, MethodOptions
from gtsam_rwhec.methods.registry import METHODS, estimate_of, method_of, run
from gtsam_rwhec.problem.problem import Problem
from gtsam_rwhec.solver.certificate import Certificate
from gtsam_rwhec.solver.residuals import Residual
from gtsam_rwhec.solving.solution import Solution


@dataclass(frozen=True)
class Compared:
    """One method's line: its estimate, or the error for which there is none."""

    method: Method[[Problem, MethodOptions]]
    estimate: Estimate[dict[str, gtsam.Pose3]] | None = None
    error: RwhecError | None = None

    @property
    def translation_rms_m(self) -> float:
        """Root mean square over all measurements."""
        return self._pooled([(r.number_of_measurements, r.translation_rms_m) for r in self._residuals])

    @property
    def rotation_rms_rad(self) -> float:
        """Root mean square over all measurements."""
        return self._pooled([(r.number_of_measurements, r.rotation_rms_rad) for r in self._residuals])

    @property
    def _residuals(self) -> Iterable[Residual]:
        return () if self.estimate is None else self.estimate.residuals.values()

    @staticmethod
    def _pooled(values: list[tuple[int, float]]) -> float:
        count = sum(number for number, _ in values)
        return math.sqrt(sum(number * value**2 for number, value in values) / count) if count else math.nan


@dataclass(frozen=True)
class Comparison:
    """All methods' lines, those that apply first, cheapest first.

    Attributes
    ----------
    rows : tuple of Compared
    solution : Solution or None
        The certified one, whose certificate's bound holds for every answer; None when there is none.
    error : RwhecError or None
        Why there is none.
    """

    rows: tuple[Compared, ...]
    solution: Solution | None
    error: RwhecError | None = None

    @property
    def certificate(self) -> Certificate | None:
        """What bounds every answer's cost from below."""
        return None if self.solution is None else self.solution.certificate

    def gap(self, row: Compared) -> float | None:
        """By how much a method's answer costs more than any answer must; None without a bound, or an answer."""
        if row.estimate is None or self.certificate is None or not math.isfinite(self.certificate.lower_bound):
            return None
        return max(0.0, row.estimate.cost - self.certificate.lower_bound)

    def is_optimal(self, row: Compared) -> bool:
        """Whether the answer is proven optimal under the certified objective."""
        gap = self.gap(row)
        return gap is not None and self.certificate is not None and gap <= self.certificate.tolerance


def compare(
    problem: Problem,
    options: MethodOptions | None = None,
    *,
    methods: Iterable[str] | None = None,
    progress: Progress | None = None,
) -> Comparison:
    """Solve a problem by every method that applies.

    Parameters
    ----------
    problem : Problem
    options : MethodOptions, optional
        The same for all.
    methods : iterable of str, optional
        Names; left out: all. The certified method is always solved, for its bound.
    progress : callable, optional
        Called with each method's name as it begins.

    Raises
    ------
    CountError, FrameError, UnderdeterminedError
        For a problem that nothing can solve.
    OptionError
        When a method's name is unknown.
    """
    chosen = [method_of(name) for name in (METHODS if methods is None else methods)]
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
    rows = []
    for method in dict.fromkeys(chosen):
        if method is not certified.METHOD:
            rows.append(_compared(method, problem, options, progress))
        elif solution is None:
            rows.append(Compared(method, error=error))
        else:
            outcome = certified.outcome_of(solution)
            rows.append(Compared(method, estimate_of(method.name, problem, outcome, seconds)))
    rows.sort(key=lambda row: math.inf if row.estimate is None else row.estimate.cost)
    return Comparison(tuple(rows), solution, error)


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
