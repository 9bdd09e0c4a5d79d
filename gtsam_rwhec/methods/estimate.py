"""What methods answer: the outcome of a method's own function, and the estimate that the user gets."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Generic, TypeVar

import gtsam

from gtsam_rwhec.geometry.poses import PoseLike
from gtsam_rwhec.problem.measurements import Pair
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
    """What a method proves of its own cost.

    Attributes
    ----------
    cost : float
        The answer's cost.
    cost_name : str
        The name of this cost, which may differ from ``Estimate.cost_name``.
    lower_bound : float
        No answer costs less.
    is_optimal : bool
        Whether the gap is closed, up to rounding.
    """

    cost: float
    cost_name: str
    lower_bound: float
    is_optimal: bool

    @property
    def gap(self) -> float:
        """cost - lower_bound."""
        return self.cost - self.lower_bound


@dataclass(frozen=True)
class Estimate(Generic[X]):
    """A method's answer; all methods' answers are evaluated alike.

    Attributes
    ----------
    method : str
        The method's name.
    X : dict of str to gtsam.Pose3, or gtsam.Pose3
        T_targetcarrier_target of each target, metres. For A X = X B it is one pose: T_c_h with C_i X = X H_i.
    Y : dict of str to gtsam.Pose3
        T_sensorcarrier_sensor of each sensor, metres; empty for A X = X B.
    scale : float or dict of str to float
        t_B (t_C of C X = X H) = scale * (true length); 1 when known.
    cost : float
        From ``methods.run``: J of the certified objective (eq. 18), whatever cost the method itself minimised. From
        ``handeye.solve``: the cost that ``cost_name`` names.
    cost_name : str
    proof : Proof or None
        None where the method proves nothing.
    free_directions : tuple of FreeDirection
        What the measurements leave undetermined, by this answer's residuals.
    seconds : float
        The method's own time; from ``handeye.solve`` with checks and evaluation.
    residuals : dict of (target, sensor) to Residual
        Empty for A X = X B.
    alpha : float or None
        1/m, the weight of translations in A X = X B, given or estimated; None for A X = Y B.
    starts_from : str or None
        What an iteration started from; None for closed forms and global methods.
    notes : tuple of str
        The method's remarks on this answer.
    """

    method: str
    X: X
    Y: dict[str, gtsam.Pose3]
    scale: float | dict[str, float]
    cost: float
    cost_name: str
    proof: Proof | None
    free_directions: tuple[FreeDirection, ...]
    seconds: float
    residuals: dict[Pair, Residual] = field(default_factory=dict)
    alpha: float | None = None
    starts_from: str | None = None
    notes: tuple[str, ...] = ()

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
