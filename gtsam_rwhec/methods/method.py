"""The record of a calibration method: its name, source, assumptions, and the inputs that it accepts.

The record serves A X = Y B and A X = X B. ``run`` and
``solve_hand_eye`` check the input against the record, call the method's function for an ``Outcome``, and make an
``Estimate`` of the outcome. In A X = Y B targets' poses are X and sensors' poses are Y.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from enum import Enum
from numbers import Real
from typing import Any, Generic, Literal, ParamSpec, TypeVar

import gtsam

from gtsam_rwhec.errors import CountError, FrameError, OptionError, PriorError, RwhecError, ScaleError
from gtsam_rwhec.files.terminal_text import brief, counted
from gtsam_rwhec.geometry.poses import PoseLike
from gtsam_rwhec.geometry.real_numbers import LARGEST_WHOLE, check_kind, is_whole
from gtsam_rwhec.problem.knowledge import ScaleMode, checked_scale
from gtsam_rwhec.problem.measurements import Pair
from gtsam_rwhec.problem.problem import Problem
from gtsam_rwhec.solver.answers import Residual
from gtsam_rwhec.solver.free_directions import FreeDirection

Poses = Mapping[str, PoseLike]
X = TypeVar("X")


@dataclass(frozen=True)
class Outcome(Generic[X]):
    """What a method's function returns; X and Y are poses by name, or X the one pose (4, 4) of A X = X B, metres.

    ``cost`` is the method's own cost (None when it is the cost by which the call compares all methods),
    ``lower_bound`` a proven bound on it. ``is_optimal`` says whether the bound proves the answer, where the method has
    its own rule. ``free_directions`` are given where the method finds them itself. The rest is as in ``Estimate``.
    """

    X: X
    Y: Poses = field(default_factory=dict)
    scale: float | Mapping[str, float] = 1.0
    cost: float | None = None
    cost_name: str = ""
    lower_bound: float | None = None
    is_optimal: bool | None = None
    free_directions: tuple[FreeDirection, ...] = ()
    starts_from: str | None = None
    notes: tuple[str, ...] = ()


@dataclass(frozen=True)
class Proof:
    """The bound that a method proves for its own cost."""

    cost: float  #: The answer's cost
    cost_name: str  #: The name of this cost, which may differ from ``Estimate.cost_name``.
    lower_bound: float  #: No answer costs less
    is_optimal: bool  #: Whether the gap is closed, up to rounding

    @property
    def gap(self) -> float:
        """cost - lower_bound."""
        return self.cost - self.lower_bound


@dataclass(frozen=True)
class Estimate(Generic[X]):
    """A method's answer; all methods' answers are evaluated alike."""

    method: str  #: The method's name
    X: X  #: T_targetcarrier_target of each target, metres. For A X = X B it is one pose: T_c_h with C_i X = X H_i.
    Y: dict[str, gtsam.Pose3]  #: T_sensorcarrier_sensor of each sensor, metres; empty for A X = X B
    scale: float | dict[str, float]  #: t_B (t_C of C X = X H) = scale * (true length); 1 when known
    #: From ``methods.run``: J of the certified objective (eq. 18), whatever cost the method itself minimised. From
    #: ``solve_hand_eye``: the cost that ``cost_name`` names.
    cost: float
    cost_name: str
    proof: Proof | None  #: None where the method proves nothing
    free_directions: tuple[FreeDirection, ...]  #: What the measurements leave undetermined, by this answer's residuals
    seconds: float  #: The method's own time; from ``solve_hand_eye`` with checks and evaluation
    residuals: dict[Pair, Residual] = field(default_factory=dict)  #: Empty for A X = X B
    alpha: float | None = None  #: 1/m, the weight of translations in A X = X B, given or estimated; None for A X = Y B
    starts_from: str | None = None  #: What an iteration started from; None for closed forms and global methods
    notes: tuple[str, ...] = ()  #: The method's remarks on this answer

    @property
    def lower_bound(self) -> float | None:
        """``proof.lower_bound``; None where the method proves nothing."""
        return None if self.proof is None else self.proof.lower_bound

    @property
    def gap(self) -> float | None:
        """``proof.gap``; None where the method proves nothing."""
        return None if self.proof is None else self.proof.gap

    @property
    def is_optimal(self) -> bool | None:
        """``proof.is_optimal``; None where the method proves nothing."""
        return None if self.proof is None else self.proof.is_optimal


Arguments = ParamSpec("Arguments")
#: Frames that a method solves for at once (RWHEC paper, Table 1). Empty: one X and one Y; "Xs": several Xs and one Y.
Multiple = Literal["", "Xs or Ys", "Xs", "Xs and Ys"]

#: The assumption of most methods about the noise (``Method.assumes``).
UNWEIGHTED = "All measurements equally accurate, a radian weighs as much as a metre."


class Takes(Enum):
    """The inputs that a method accepts in addition to poses (or motions) of known scale."""

    SHARED_SCALE = "an unknown scale"
    SCALE_PER_TARGET = "an unknown scale for each target"
    MOTIONS = "a sensor's own motions, A Y = Y B, in a problem"
    PRIORS = "a prior"
    LINEAR_PRIORS = "a prior of the form 'distance' (DQ paper, eq. 25)"
    MOMENTS = "a problem whose raw measurements were not kept"
    WEIGHTS = "weights of the motions"
    COVARIANCES = "covariances of the motions' residuals"
    CORNERS = "corners in pixels, of all measurements of a problem, in place of poses"


@dataclass(frozen=True)
class Properties:
    """A method's line in the RWHEC paper's Table 1."""

    representation: str  #: How the method writes a pose
    #: Rotations and translations are estimated together: measured translations affect the rotations found
    joint: bool = True
    probabilistic: bool = False  #: The method has a noise model
    certifiable: bool = False  #: The answer comes with a proof of optimality for the method's own cost
    multiple: Multiple = ""  #: The frames that the method solves for at once
    monocular: bool = False  #: The method estimates an unknown scale that all targets share


@dataclass(frozen=True)
class Method(Generic[Arguments]):
    """One published method."""

    name: str  #: Its key in ``METHODS``
    #: Makes an ``Outcome`` from (problem, options) for A X = Y B, from a ``Request`` for A X = X B
    function: Callable[Arguments, Outcome[Any]]
    properties: Properties
    source: str  #: The publication
    assumes: str  #: What must hold for a correct answer, and where the method fails
    takes: frozenset[Takes] = frozenset()
    #: Raises a ``RwhecError`` for a problem that the method cannot solve for another reason
    check: Callable[[Problem], None] | None = None


@dataclass(frozen=True)
class MethodOptions:
    """Options of all methods; a method ignores the options that it does not need."""

    #: Poses by name, metres, and alpha, for methods that descend from a start. Left out, they start from a closed
    #: form's answer; ``Estimate.starts_from`` names the closed form.
    start: tuple[Poses, Poses, float] | None = None
    seed: int = 0  #: Seed of random numbers
    max_iterations: int = 1000  #: Most iterations of methods that iterate

    def __post_init__(self) -> None:
        start = self.start
        if start is not None and not (
            isinstance(start, tuple)
            and len(start) == 3
            and all(isinstance(part, kind) for part, kind in zip(start, (Mapping, Mapping, Real), strict=True))
        ):
            raise OptionError(
                f"MethodOptions.start={brief(start)}; give (X, Y, scale): poses of targets and of sensors by name, and "
                "a scale (1.0 if known)"
            )
        for name, least in (("seed", 0), ("max_iterations", 1)):
            value = getattr(self, name)
            if not is_whole(value, least):
                raise OptionError(
                    f"MethodOptions.{name}={brief(value)}; give a whole number from {least} to {LARGEST_WHOLE}"
                )


def checked_options(options: MethodOptions | None) -> MethodOptions:
    """The options, or the usual ones; an OptionError for options of another type."""
    check_kind(options, MethodOptions | None, "options", "a gtsam_rwhec.methods.MethodOptions")
    return options or MethodOptions()


def checked_start(
    targets: tuple[str, ...], sensors: tuple[str, ...], start: tuple[Poses, Poses, float]
) -> tuple[Poses, Poses, float]:
    """The start, if it has every target and sensor (else FrameError) and a positive scale (else ScaleError)."""
    X, Y, scale = start
    for what, poses, names in (("X", X, targets), ("Y", Y, sensors)):
        missing = [name for name in names if name not in poses]
        if missing:
            raise FrameError(f"the start's {what} has no {missing[0]}; it has {', '.join(poses) or 'none'}")
    return X, Y, checked_scale(scale, "the start's scale (1.0 if it is known)")


#: A X = Y B of one X and one Y takes this many measurements: they give two motions about axes that are not parallel.
FEWEST = 3
#: What a method must accept for each kind of scale.
_FOR_SCALE: dict[ScaleMode, frozenset[Takes]] = {
    "known": frozenset(),
    "shared": frozenset({Takes.SHARED_SCALE}),
    "per_target": frozenset({Takes.SCALE_PER_TARGET}),
}


def refusal(method: Method[Any], problem: Problem) -> RwhecError | None:
    """The error with which a method refuses a problem; None if it takes the problem."""
    try:
        check_problem(method, problem)
    except OptionError:  # such a call is wrong, whatever the method can do
        raise
    except RwhecError as error:
        return error
    return None


def check_problem(method: Method[Any], problem: Problem) -> None:
    """Refuse a problem that the method cannot solve.

    Raises CountError, FrameError, MeasurementsNotKeptError, OptionError, PriorError or ScaleError, or what the method's
    own check raises.
    """
    check_kind(method, Method, "the method", "a record of gtsam_rwhec.methods.METHODS")
    takes = method.takes
    check_kind(problem, Problem, "the problem", "a gtsam_rwhec.Problem")
    problem.require_pairs()
    if not takes >= _FOR_SCALE[problem.scale]:
        scales = [mode for mode, needed in _FOR_SCALE.items() if takes >= needed]
        raise ScaleError(
            f"this method takes scale={' or '.join(map(repr, scales))}, and the problem has scale={problem.scale!r}"
        )
    if problem.directed and Takes.PRIORS not in takes:
        raise OptionError(
            f"this method takes whole poses, and measurements of {next(iter(problem.directed))} weigh by direction "
            "(points, planes, directional=True); take 'certified'"
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
        raise FrameError(
            f"this method solves for {what}; the problem has {counted(targets, 'target')}, "
            f"{counted(sensors, 'sensor')} and {counted(len(problem.pairs), 'pair')}"
        )
    if targets == sensors == 1 and Takes.PRIORS not in method.takes and problem.number_of_measurements < FEWEST:
        raise CountError(
            f"the problem has {problem.number_of_measurements} measurements; one target and one sensor take at least "
            f"{FEWEST}, turned about axes that are not parallel"
        )
