"""Which methods can solve a problem, and why the others cannot."""

from __future__ import annotations

from typing import Any

from gtsam_rwhec.errors import CountError, FrameError, OptionError, PriorError, RwhecError, ScaleError
from gtsam_rwhec.methods.method import Method, Takes
from gtsam_rwhec.problem.knowledge import ScaleMode
from gtsam_rwhec.problem.problem import Problem

#: A X = Y B of one X and one Y takes this many measurements: they give two motions about axes that are not parallel.
FEWEST = 3
#: A method must take this for each kind of scale.
_FOR_SCALE: dict[ScaleMode, frozenset[Takes]] = {
    "known": frozenset(),
    "shared": frozenset({Takes.SHARED_SCALE}),
    "per_target": frozenset({Takes.SCALE_PER_TARGET}),
}


def refusal(method: Method[Any], problem: Problem) -> RwhecError | None:
    """The error with which a method refuses a problem; None if it takes the problem."""
    if not isinstance(method, Method) or not isinstance(problem, Problem):
        check_problem(method, problem)  # raises: such a call is wrong, whatever the method can do
    try:
        check_problem(method, problem)
    except RwhecError as error:
        return error
    return None


def check_problem(method: Method[Any], problem: Problem) -> None:
    """Refuse a problem that the method cannot solve.

    Raises CountError, FrameError, MeasurementsNotKeptError, OptionError, PriorError or ScaleError, or what the method's
    own check raises.
    """
    if not isinstance(method, Method):
        raise OptionError(f"the method is a {type(method).__name__}; give a record of gtsam_rwhec.methods.METHODS")
    takes = method.takes
    if not isinstance(problem, Problem):
        raise OptionError(f"the problem is a {type(problem).__name__}; give a gtsam_rwhec.Problem")
    problem.require_pairs()
    if not takes >= _FOR_SCALE[problem.scale]:
        scales = [mode for mode, needed in _FOR_SCALE.items() if takes >= needed]
        raise ScaleError(
            f"this method takes scale={' or '.join(map(repr, scales))}, and the problem has scale={problem.scale!r}"
        )
    motions = [pair.sensor for pair in problem.pairs if pair.is_motion]
    if motions and Takes.MOTIONS not in takes:
        raise FrameError(f"this method solves A X = Y B, and {motions[0]} has motions of its own (A Y = Y B)")
    if (problem.fixed or problem.priors) and Takes.PRIORS not in takes:
        named = ", ".join(dict.fromkeys([*problem.fixed, *problem.priors]))
        raise PriorError(f"this method takes neither fixed frames nor priors, and the problem has some for {named}")
    _check_frames(method, problem)
    if Takes.MOMENTS not in takes:
        problem.require_raw_measurements("this method")
    if method.check is not None:
        method.check(problem)


def _check_frames(method: Method[Any], problem: Problem) -> None:
    targets, sensors = len(problem.targets), len(problem.sensors)
    alone = "one target and one sensor" + (", or one sensor's motions" if Takes.MOTIONS in method.takes else "")
    can, what = {
        "": (len(problem.pairs) == 1, alone),
        "Xs": (sensors == 1, "several targets and one sensor"),
        "Xs or Ys": (min(targets, sensors) <= 1, "several targets or several sensors, not both"),
        "Xs and Ys": (True, ""),
    }["Xs and Ys" if Takes.CORNERS in method.takes else method.properties.multiple]
    if not can:
        pairs = len(problem.pairs)
        raise FrameError(
            f"this method solves for {what}; the problem has {targets} target{'s' * (targets != 1)}, {sensors} "
            f"sensor{'s' * (sensors != 1)} and {pairs} pair{'s' * (pairs != 1)}"
        )
    if targets == sensors == 1 and Takes.PRIORS not in method.takes and problem.number_of_measurements < FEWEST:
        raise CountError(
            f"the problem has {problem.number_of_measurements} measurements; one target and one sensor take at least "
            f"{FEWEST}, turned about axes that are not parallel"
        )
