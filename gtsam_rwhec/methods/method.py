"""The record of a calibration method: its name, its source, what it assumes, what it takes.

The record serves A X = Y B (``gtsam_rwhec.methods``) and A X = X B (``gtsam_rwhec.handeye``). ``run`` and
``handeye.solve`` check the input against the record, call the method's function for an ``Outcome``, and make an
``Estimate`` of the outcome. In A X = Y B targets' poses are X and sensors' poses are Y.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from enum import Enum
from numbers import Real
from typing import Any, Generic, Literal, ParamSpec

from gtsam_rwhec.errors import FrameError, OptionError
from gtsam_rwhec.files.terminal_text import brief
from gtsam_rwhec.geometry.real_numbers import LARGEST_WHOLE, is_whole
from gtsam_rwhec.methods.estimate import Outcome, Poses
from gtsam_rwhec.problem.knowledge import checked_scale
from gtsam_rwhec.problem.problem import Problem

Arguments = ParamSpec("Arguments")
#: Frames that a method solves for at once (RWHEC paper, Table 1). Empty: one X and one Y; "Xs": several Xs and one Y.
Multiple = Literal["", "Xs or Ys", "Xs", "Xs and Ys"]

#: What most methods assume of the noise (``Method.assumes``).
UNWEIGHTED = "All measurements equally accurate, a radian weighs as much as a metre."


class Takes(Enum):
    """What a method takes besides poses (or motions) of known scale."""

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
    """A method's line in the RWHEC paper's Table 1.

    Attributes
    ----------
    representation : str
        How the method writes a pose.
    joint : bool
        Rotations and translations are estimated together: measured translations affect the rotations found.
    probabilistic : bool
        The method has a noise model.
    certifiable : bool
        The answer comes with a proof of optimality for the method's own cost.
    multiple : "", "Xs or Ys", "Xs" or "Xs and Ys"
        The frames that the method solves for at once.
    monocular : bool
        The method estimates an unknown scale that all targets share.
    """

    representation: str
    joint: bool = True
    probabilistic: bool = False
    certifiable: bool = False
    multiple: Multiple = ""
    monocular: bool = False


@dataclass(frozen=True)
class Method(Generic[Arguments]):
    """One published method.

    Attributes
    ----------
    name : str
        Its key in ``METHODS``.
    function : callable
        Makes an ``Outcome`` from (problem, options) for A X = Y B, from a ``handeye.Request`` for A X = X B.
    properties : Properties
    source : str
        The publication.
    assumes : str
        What must hold for a correct answer, and where the method fails.
    takes : frozenset of Takes
    check : callable, optional
        Raises a ``RwhecError`` for a problem that the method cannot solve for another reason.
    """

    name: str
    function: Callable[Arguments, Outcome[Any]]
    properties: Properties
    source: str
    assumes: str
    takes: frozenset[Takes] = frozenset()
    check: Callable[[Problem], None] | None = None


@dataclass(frozen=True)
class MethodOptions:
    """Options of all methods; a method ignores the options that it does not need.

    Attributes
    ----------
    start : (X, Y, scale), optional
        Poses by name, metres, and alpha, for methods that descend from a start. Left out, they start from a closed
        form's answer; ``Estimate.starts_from`` names the closed form.
    seed : int
        Seed of random numbers.
    max_iterations : int
        Most iterations of methods that iterate.
    """

    start: tuple[Poses, Poses, float] | None = None
    seed: int = 0
    max_iterations: int = 1000

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


def check_options(options: object) -> None:
    """Raise an OptionError for options of another type."""
    if options is not None and not isinstance(options, MethodOptions):
        raise OptionError(f"options is a {type(options).__name__}; give a gtsam_rwhec.methods.MethodOptions")


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
