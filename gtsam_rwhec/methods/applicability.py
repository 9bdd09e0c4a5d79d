"""Which methods can solve a problem, and why the others cannot."""

from __future__ import annotations

from typing import Any

from gtsam_rwhec.errors import (
    CountError,
    FrameError,
    OptionError,
    PriorError,
    RwhecError,
    ScaleError,
)
from gtsam_rwhec.methods.method import Method, Takes
from gtsam_rwhec.problem.knowledge import ScaleMode
from gtsam_rwhec.problem.problem import Problem

#: A X = Y B of one X and one Y takes two relative motions, three poses, about axes that are not parallel.
FEWEST = 3
#: What a method must take for each kind of scale.
_FOR_SCALE: dict[ScaleMode, frozenset[Takes]] = {
    "known": frozenset(),
    "shared": frozenset({Takes.SHARED_SCALE}),
    "per_target": frozenset({Takes.SCALE_PER_TARGET}),
}


def refusal(method: Method[Any], problem: Problem) -> RwhecError | None:
    """The error with which a method refuses a problem; None if it takes it."""
    try:
        check_problem(method, problem)
    except RwhecError as error:
        return error
    return None


def check_problem(method: Method[Any], problem: Problem) -> None:
    """Refuse a problem that the method cannot solve.

    Raises
    ------
    CountError, FrameError, MeasurementsNotKeptError, OptionError, PriorError, ScaleError
    """
    name, takes = method.name, method.takes
    if not isinstance(problem, Problem):
        raise OptionError(f"the problem is a {type(problem).__name__}; give a gtsam_rwhec.Problem")
    problem.require_pairs()
    if not takes >= _FOR_SCALE[problem.scale]:
        scales = [mode for mode, needed in _FOR_SCALE.items() if takes >= needed]
        raise ScaleError(
            f"{name} takes scale={' or '.join(map(repr, scales))}, and this problem has scale={problem.scale!r}; "
            + ("it has one scale for all" if len(scales) > 1 else "it has no scale")
        )
    motions = [pair.sensor for pair in problem.pairs if pair.is_motion]
    if motions and Takes.MOTIONS not in takes:
        raise FrameError(f"{name} solves A X = Y B, and {motions[0]} has motions of its own (A Y = Y B)")
    if (problem.fixed or problem.priors) and Takes.PRIORS not in takes:
        named = ", ".join(dict.fromkeys([*problem.fixed, *problem.priors]))
        raise PriorError(f"{name} has neither fixed frames nor priors, and there are some for {named}")
    _check_frames(method, problem)
    if Takes.MOMENTS not in takes:
        problem.require_raw_measurements(name)
    if method.check is not None:
        method.check(problem)


def _check_frames(method: Method[Any], problem: Problem) -> None:
    name, takes = method.name, method.takes
    targets, sensors = len(problem.targets), len(problem.sensors)
    can, what = {
        "": (targets == sensors == 1, "one target and one sensor"),
        "Xs": (sensors == 1, "several targets and one sensor"),
        "Xs or Ys": (min(targets, sensors) <= 1, "several targets or several sensors, not both"),
        "Xs and Ys": (True, ""),
    }[method.properties.multiple]
    alone = Takes.MOTIONS in takes and targets == 0 and sensors == 1  # A Y = Y B of one sensor
    if not can and not alone:
        raise FrameError(
            f"{name} solves for {what}; here are {targets} target{'s' * (targets != 1)} and {sensors} "
            f"sensor{'s' * (sensors != 1)}"
        )
    if targets == sensors == 1 and Takes.PRIORS not in takes and problem.number_of_measurements < FEWEST:
        raise CountError(
            f"{name}: {problem.number_of_measurements} measurements; one target and one sensor take at least "
            f"{FEWEST}, turned about axes that are not parallel"
        )
