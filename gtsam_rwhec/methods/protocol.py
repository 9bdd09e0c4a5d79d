"""What every method has in common: what it is, what it takes, what it refuses in words, what it returns.

A method's module has a ``Method`` whose function makes a ``Calibration`` of a problem; ``registry.run`` checks the
problem against the method's properties first, and evaluates the calibration under the certified objective afterwards.
Targets' poses are the X of A X = Y B, sensors' poses the Y.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from numbers import Integral, Real
from typing import Literal

import gtsam
import numpy as np

from gtsam_rwhec.errors import (
    CountError,
    FrameError,
    MeasurementsNotKeptError,
    OptionError,
    PriorError,
    RwhecError,
    ScaleError,
)
from gtsam_rwhec.geometry.poses import PoseLike
from gtsam_rwhec.problem.knowledge import ScaleMode
from gtsam_rwhec.problem.pairs import Pair
from gtsam_rwhec.problem.problem import Problem
from gtsam_rwhec.solver.residuals import Residual

#: How many frames a method solves for at once (RWHEC paper, Table 1): one X and one Y; several of one side with one
#: of the other; several of both.
Multiple = Literal["", "Xs or Ys", "Xs", "Xs and Ys"]
Poses = Mapping[str, PoseLike]
Scale = float | Mapping[str, float]

#: A X = Y B of one X and one Y takes two relative motions, three poses, about axes that are not parallel.
FEWEST = 3


@dataclass(frozen=True)
class Properties:
    """A method's line in the RWHEC paper's Table 1.

    Attributes
    ----------
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
    representation : str
        Of the poses.
    """

    joint: bool
    probabilistic: bool
    certifiable: bool
    multiple: Multiple
    monocular: bool
    representation: str


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


@dataclass(frozen=True)
class Calibration:
    """What a method's function returns: poses by name, metres, and alpha.

    ``starts_from`` says what an iteration started from, ``notes`` what the user should know of this answer.
    """

    X: Poses
    Y: Poses
    scale: Scale = 1.0
    starts_from: str | None = None
    notes: tuple[str, ...] = ()


@dataclass(frozen=True)
class Estimate:
    """A method's answer, evaluated as the certified solver's is.

    Attributes
    ----------
    method : str
    X : dict of str to gtsam.Pose3
        T_targetcarrier_target of each target, metres.
    Y : dict of str to gtsam.Pose3
        T_sensorcarrier_sensor of each sensor, metres.
    scale : float or dict of str to float
        t_B = scale * true length; 1 when known.
    cost : float
        J of the certified objective (eq. 18), whatever the method itself minimised.
    residuals : dict of (target, sensor) to Residual
    seconds : float
        The method's own time, without checks and evaluation.
    starts_from : str or None
        What an iteration started from; None for closed forms and global methods.
    notes : tuple of str
        What the method says of this answer.
    free_directions : tuple of str
        What the measurements leave undetermined, in words, judged by this answer's residuals; empty when nothing.
    """

    method: str
    X: dict[str, gtsam.Pose3]
    Y: dict[str, gtsam.Pose3]
    scale: float | dict[str, float]
    cost: float
    residuals: dict[Pair, Residual]
    seconds: float
    starts_from: str | None = None
    notes: tuple[str, ...] = ()
    free_directions: tuple[str, ...] = ()


@dataclass(frozen=True)
class Method:
    """One published method.

    Attributes
    ----------
    name : str
        Its key in ``METHODS``.
    properties : Properties
    source : str
        Where it was published.
    assumes : str
        What it takes for granted, and where it fails.
    function : callable
        Takes (problem, options), returns a ``Calibration``.
    scales : tuple of "known", "shared", "per_target"
        Which kinds of problem it solves; left out: by ``properties.monocular``.
    takes_motions, takes_priors, takes_moments : bool
        Whether it can use a sensor's own motions (A Y = Y B); fixed frames and priors; a problem whose raw measurements
        were not kept.
    check : callable, optional
        Raises a ``RwhecError`` for what else it cannot handle.
    """

    name: str
    properties: Properties
    source: str
    assumes: str
    function: Callable[[Problem, MethodOptions], Calibration]
    scales: tuple[ScaleMode, ...] = ()
    takes_motions: bool = False
    takes_priors: bool = False
    takes_moments: bool = False
    check: Callable[[Problem], None] | None = None

    def applies(self, problem: Problem) -> str:
        """Why the method cannot solve the problem, in words; empty if it can."""
        try:
            self.check_problem(problem)
        except RwhecError as error:
            return str(error)
        return ""

    def check_problem(self, problem: Problem) -> None:
        """Refuse what the method has no place for.

        Raises
        ------
        CountError, FrameError, MeasurementsNotKeptError, PriorError, ScaleError
        """
        if not isinstance(problem, Problem):
            raise OptionError(f"the problem is a {type(problem).__name__}; give a gtsam_rwhec.Problem")
        if not problem.pairs:
            raise CountError("the problem is empty: no measurements; add some with problem.add(target, sensor, A, B)")
        scales = self.scales or (("known", "shared") if self.properties.monocular else ("known",))
        if problem.scale not in scales:
            raise ScaleError(
                f"{self.name} takes scale={' or '.join(map(repr, scales))}, and this problem has "
                f"scale={problem.scale!r}; " + ("it has one scale for all" if len(scales) > 1 else "it has no scale")
            )
        motions = [pair.sensor for pair in problem.pairs if pair.is_motion]
        if motions and not self.takes_motions:
            raise FrameError(f"{self.name} solves A X = Y B, and {motions[0]} has motions of its own (A Y = Y B)")
        if (problem.fixed or problem.priors) and not self.takes_priors:
            named = ", ".join(dict.fromkeys([*problem.fixed, *problem.priors]))
            raise PriorError(f"{self.name} has neither fixed frames nor priors, and there are some for {named}")
        self._check_frames(problem)
        if not problem.has_measurements and not self.takes_moments:
            raise MeasurementsNotKeptError(
                f"{self.name} needs the raw measurements, and they were not kept; make the problem with "
                "keep_measurements=True"
            )
        if self.check is not None:
            self.check(problem)

    def _check_frames(self, problem: Problem) -> None:
        targets, sensors = len(problem.targets), len(problem.sensors)
        takes = {
            "": (targets == sensors == 1, "one target and one sensor"),
            "Xs": (sensors == 1, "several targets and one sensor"),
            "Xs or Ys": (min(targets, sensors) <= 1, "several targets or several sensors, not both"),
            "Xs and Ys": (True, ""),
        }
        can, what = takes[self.properties.multiple]
        alone = self.takes_motions and targets == 0 and sensors == 1  # A Y = Y B of one sensor
        if not can and not alone:
            raise FrameError(
                f"{self.name} solves for {what}; here are {targets} target{'s' * (targets != 1)} and {sensors} "
                f"sensor{'s' * (sensors != 1)}"
            )
        if targets == sensors == 1 and not self.takes_priors and problem.number_of_measurements < FEWEST:
            raise CountError(
                f"{self.name}: {problem.number_of_measurements} measurements; one target and one sensor take at least "
                f"{FEWEST}, turned about axes that are not parallel"
            )


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
