"""Checks that a problem, its solution and the options of a refinement agree."""

from __future__ import annotations

from gtsam_rwhec.errors import FrameError, OptionError, ScaleError
from gtsam_rwhec.problem.problem import Problem
from gtsam_rwhec.refinement.options import RefineOptions
from gtsam_rwhec.solving.arguments import check_against_knowledge
from gtsam_rwhec.solving.solution import Solution


def check_inputs(problem: Problem, solution: Solution | None, options: RefineOptions) -> None:
    """Refuse a problem that cannot be refined from this solution with these options; ``refine`` lists the errors."""
    if not isinstance(problem, Problem):
        raise OptionError(f"the problem is a {type(problem).__name__}; give a gtsam_rwhec.Problem")
    if not isinstance(solution, Solution) and (solution is not None or getattr(options, "robust", "") != "gnc"):
        raise OptionError(
            f"the solution is a {type(solution).__name__}; give what gtsam_rwhec.solve returned (or None with "
            "robust='gnc')"
        )
    if not isinstance(options, RefineOptions):
        raise OptionError(f"options is a {type(options).__name__}; give a gtsam_rwhec.RefineOptions")
    if options.observations == "corners":
        raise OptionError("observations='corners': call gtsam_rwhec.refine, which refines on from here by the corners")
    problem.require_pairs()
    if solution is not None:
        _check_solution(problem, solution)
    if options.noise == "given" and problem.is_relative:
        raise OptionError(
            "noise='given', but some measurements were added without sigma or kappa; take noise='estimate', or add "
            "sigma and kappa"
        )
    if options.robust == "gnc":
        problem.require_raw_measurements("robust='gnc'")


def _check_solution(problem: Problem, solution: Solution) -> None:
    if solution.scale_mode != problem.scale:
        raise ScaleError(
            f"the solution is of a problem with scale={solution.scale_mode!r}, but this problem has "
            f"scale={problem.scale!r}; solve this problem first"
        )
    try:
        check_against_knowledge(problem, solution.X, solution.Y, solution.scale)
    except FrameError as error:
        raise FrameError(f"the solution is of another problem; solve this problem first ({error})") from error


def sensors_with_offset(problem: Problem, options: RefineOptions) -> tuple[str, ...]:
    """The sensors whose time offsets are to be estimated."""
    if isinstance(options.time_offsets, bool):
        return problem.sensors if options.time_offsets else ()
    for name in options.time_offsets:
        if name not in problem.sensors:
            raise FrameError(
                f"RefineOptions.time_offsets names {name!r}, which is not a sensor; give any of "
                f"{', '.join(problem.sensors)}"
            )
    return tuple(options.time_offsets)
