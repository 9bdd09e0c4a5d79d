"""The prior of the DQ paper's cost (Section 3.3): a pose known beforehand, with weights."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Literal, get_args

import numpy as np

from gtsam_rwhec.errors import PriorError
from gtsam_rwhec.files.terminal_text import brief
from gtsam_rwhec.geometry.poses import Array, PoseLike, one_transform
from gtsam_rwhec.geometry.quaternions import conjugate, left
from gtsam_rwhec.geometry.real_numbers import is_between, is_one_of
from gtsam_rwhec.handeye.cost import DualQuaternionCost
from gtsam_rwhec.handeye.dual_quaternions import from_transforms
from gtsam_rwhec.handeye.weights import LARGEST

PriorForm = Literal["imaginary", "distance"]
#: G of eq. 26 selects the imaginary parts.
G = np.diag([1.0, 1.0, 1.0, 0.0])


@dataclass(frozen=True)
class DualQuaternionPrior:
    """A prior that the hand-eye pose is near T: Q = Q_0 (x) dQ with dQ near 1.

    For a small deviation from T, by an angle theta and a length d, it adds a theta^2 / 4 + b d^2 / 4 to the cost.

    Parameters
    ----------
    T : gtsam.Pose3 or (4, 4) array
        T_c_h, metres.
    a, b : float
        Weights of the rotation and of the translation (1/m^2): not negative, and not both zero.
    form : "imaginary" or "distance"
        "imaginary" adds a dq'G dq + b |dq'|^2 (eq. 26) and keeps all properties of the cost. "distance" adds
        a |1 - dq|^2 + b |dq'|^2 (eq. 25), which has a linear term (``linear_prior``).

    Raises
    ------
    PoseError, PriorError
        When T is not a pose, or a weight cannot be used.
    """

    T: PoseLike
    a: float
    b: float
    form: PriorForm = "imaginary"

    def __post_init__(self) -> None:
        for name, weight in (("a", self.a), ("b", self.b)):
            if not is_between(weight, 0.0, LARGEST):
                raise PriorError(
                    f"the prior's {name}={brief(weight)} is not a weight; give a number from 0 to {LARGEST:g}"
                )
        if self.a == 0.0 and self.b == 0.0:
            raise PriorError("the prior's weights a and b are both 0; give a weight above 0, or leave the prior out")
        if not is_one_of(self.form, get_args(PriorForm)):
            raise PriorError(f"the prior's form={brief(self.form)} is not 'imaginary' (eq. 26) or 'distance' (eq. 25)")
        object.__setattr__(self, "T", one_transform(self.T, "the prior's pose"))

    @cached_property
    def dual_quaternion(self) -> tuple[Array, Array]:
        """q_0 and q_0' (4,)."""
        q, q_dual = from_transforms(np.asarray(self.T)[None])
        return q[0], q_dual[0]

    @cached_property
    def _deviation(self) -> tuple[Array, Array]:
        # dQ = Q_0* (x) Q (eq. 27): dq = L* q, dq' = L'* q + L* q'.
        q, q_dual = self.dual_quaternion
        return left(conjugate(q)), left(conjugate(q_dual))

    def added_to(self, cost: DualQuaternionCost) -> DualQuaternionCost:
        """The cost with the prior's quadratic terms (eq. 29); of the form "distance", with the translation's term only.

        The paper drops the constant b |q_0'|^2 |q|^2 from eq. 28. It is kept here: the cost stays a sum of squares.
        """
        L, L_dual = self._deviation
        S = cost.S + self.b * L_dual.T @ L_dual
        if self.form == "imaginary":
            S = S + self.a * L.T @ G @ L
        return DualQuaternionCost(S, cost.M + self.b * np.eye(4), cost.W + self.b * L_dual.T @ L, cost.count)

    def value(self, q: Array, q_dual: Array) -> float:
        """The prior's term of the cost of a pose, parts (4,) of either sign."""
        L, L_dual = self._deviation
        dq, dq_dual = L @ q, L_dual @ q + L @ q_dual
        if self.form == "imaginary":
            rotation = float(dq[:3] @ dq[:3])
        else:  # |1 - dq|^2 with the sign of dq that is nearer 1
            rotation = float(dq[:3] @ dq[:3] + (1.0 - abs(dq[3])) ** 2)
        return self.a * rotation + self.b * float(dq_dual @ dq_dual)
