"""What a method of calibration is: its name and source, what it assumes, what it takes.

One record serves A X = Y B (``gtsam_rwhec.methods``) and A X = X B (``gtsam_rwhec.handeye``). A method's function makes
an ``Outcome``; the package's one call checks what is given against the record first, and makes an ``Estimate`` of the
outcome. Targets' poses are the X of A X = Y B, sensors' poses the Y.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from enum import Enum
from numbers import Integral, Real
from typing import Any, Generic, Literal, ParamSpec

import numpy as np

from gtsam_rwhec.errors import FrameError, OptionError, ScaleError
from gtsam_rwhec.methods.estimate import Outcome, Poses
from gtsam_rwhec.problem.problem import Problem

Arguments = ParamSpec("Arguments")
#: How many frames a method solves for at once (RWHEC paper, Table 1): one X and one Y; several of one side with one
#: of the other; several of both.
Multiple = Literal["", "Xs or Ys", "Xs", "Xs and Ys"]

#: What most methods assume of the noise (``Method.assumes``).
UNWEIGHTED = "All measurements equally accurate, a radian weighs as much as a metre."


class Takes(Enum):
    """What a method can use besides poses (or motions) of known scale."""

    SHARED_SCALE = "an unknown scale"
    SCALE_PER_TARGET = "an unknown scale for each target"
    MOTIONS = "a sensor's own motions, A Y = Y B, in a problem"
    PRIORS = "a prior"
    LINEAR_PRIORS = "a prior of the form 'distance' (DQ paper, eq. 25)"
    MOMENTS = "a problem whose raw measurements were not kept"
    WEIGHTS = "weights of the motions"
    COVARIANCES = "covariances of the motions' residuals"


@dataclass(frozen=True)
class Properties:
    """A method's line in the RWHEC paper's Table 1.

    Attributes
    ----------
    representation : str
        Of the poses.
    joint : bool
        Whether rotations and translations are estimated together, so that the translations measured move the
        rotations found.
    probabilistic : bool
        Whether the problem is an estimate under a model of the noise.
    certifiable : bool
        Whether the answer comes with a proof of optimality for the method's own cost.
    multiple : "", "Xs or Ys", "Xs" or "Xs and Ys"
    monocular : bool
        Whether an unknown scale, shared by all targets, is estimated too.
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
        Makes an ``Outcome``: of (problem, options) for A X = Y B, of a ``handeye.Request`` for A X = X B.
    properties : Properties
    source : str
        Where it was published.
    assumes : str
        What must hold for its answer to be what it claims, and where it fails.
    takes : frozenset of Takes
    check : callable, optional
        Raises a ``RwhecError`` for a problem that it cannot handle for another reason.
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
    """What a method may be told; each uses what it has a use for.

    Attributes
    ----------
    start : (X, Y, scale), optional
        Poses by name, in true metres, and alpha, for methods that descend from a start. Left out: a closed form's
        answer; ``Estimate.starts_from`` says which.
    seed : int
        Of what is drawn at random.
    max_iterations : int
        Of methods that iterate.
    """

    start: tuple[Poses, Poses, float] | None = None
    seed: int = 0
    max_iterations: int = 1000

    def __post_init__(self) -> None:
        if self.start is not None:
            given = self.start if isinstance(self.start, tuple) and len(self.start) == 3 else (None, None, None)
            if not (isinstance(given[0], Mapping) and isinstance(given[1], Mapping) and isinstance(given[2], Real)):
                raise OptionError(
                    f"MethodOptions.start={self.start!r:.100}; give (X, Y, scale): poses of targets and of sensors by "
                    "name, and a scale (1.0 if known)"
                )
        for name, least in (("seed", 0), ("max_iterations", 1)):
            value = getattr(self, name)
            if isinstance(value, bool) or not isinstance(value, Integral) or value < least:
                raise OptionError(f"MethodOptions.{name}={value!r}; give a whole number of at least {least}")


def checked_start(problem: Problem, start: tuple[Poses, Poses, float]) -> tuple[Poses, Poses, float]:
    """A start that has every frame of the problem.

    Raises
    ------
    FrameError, ScaleError
    """
    X, Y, scale = start
    for what, poses, names in (("X", X, problem.targets), ("Y", Y, problem.sensors)):
        missing = [name for name in names if name not in poses]
        if missing:
            raise FrameError(f"the start's {what} has no {missing[0]}; it has {', '.join(poses) or 'none'}")
    if not (isinstance(scale, (int, float)) and np.isfinite(scale) and scale > 0.0):
        raise ScaleError(f"the start's scale is {scale!r}; give a positive number, 1.0 if it is known")
    return start
