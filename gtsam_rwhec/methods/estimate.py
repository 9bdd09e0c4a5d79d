"""What methods answer: the outcome of a method's own function, and the estimate that its user gets."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Generic, TypeVar

import gtsam

from gtsam_rwhec.geometry.poses import PoseLike
from gtsam_rwhec.identifiability.free_directions import FreeDirection
from gtsam_rwhec.problem.pairs import Pair
from gtsam_rwhec.solver.residuals import Residual

Poses = Mapping[str, PoseLike]
X = TypeVar("X")


@dataclass(frozen=True)
class Outcome(Generic[X]):
    """What a method's function returns.

    Attributes
    ----------
    X, Y : poses by name, or the one pose (4, 4) of A X = X B
        Metres.
    cost : float or None
        The method's own; None: that by which the call compares all methods.
    cost_name : str
        Which cost that is.
    lower_bound : float or None
        Proven, of the same cost.
    is_optimal : bool or None
        Whether the bound proves the answer, where the method has its own rule for that.
    scale, free_directions, starts_from, notes
        As in ``Estimate``; free directions where the method finds them itself.
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
        Of the answer.
    cost_name : str
        Which cost that is; it need not be the estimate's.
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
    """A method's answer, evaluated as those of all others are.

    Attributes
    ----------
    method : str
    X : dict of str to gtsam.Pose3, or gtsam.Pose3
        T_targetcarrier_target of each target, metres; of A X = X B the one pose, T_c_h with C_i X = X H_i.
    Y : dict of str to gtsam.Pose3
        T_sensorcarrier_sensor of each sensor, metres; none of A X = X B.
    scale : float or dict of str to float
        t_B (t_C of C X = X H) = scale * (true length); 1 when known.
    cost : float
        By which the answers of ``methods.run`` are compared, J of the certified objective (eq. 18), whatever the
        method itself minimised; of ``handeye.solve``, the cost that ``cost_name`` says.
    cost_name : str
    proof : Proof or None
        None where the method proves nothing.
    free_directions : tuple of FreeDirection
        What the measurements leave undetermined, judged by this answer's residuals; empty when nothing.
    seconds : float
        The method's own time; of ``handeye.solve``, with checks and evaluation.
    residuals : dict of (target, sensor) to Residual
        Empty of A X = X B.
    alpha : float or None
        1/m, the weight of translations that A X = X B was solved with, given or estimated; None of A X = Y B.
    starts_from : str or None
        What an iteration started from; None for closed forms and global methods.
    notes : tuple of str
        What the method says of this answer.
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
        """No answer has a lower cost, of the cost that ``proof`` names; None where the method proves nothing."""
        return None if self.proof is None else self.proof.lower_bound

    @property
    def gap(self) -> float | None:
        """``proof.gap``; None where the method proves nothing."""
        return None if self.proof is None else self.proof.gap

    @property
    def is_optimal(self) -> bool | None:
        """Whether the answer is proven optimal for the method's own cost; None where the method proves nothing."""
        return None if self.proof is None else self.proof.is_optimal
