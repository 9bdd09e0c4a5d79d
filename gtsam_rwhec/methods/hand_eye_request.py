"""The input of every AX = XB method, the prior of the DQ paper's cost (Section 3.3), and the free directions."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Literal, get_args

import numpy as np

from gtsam_rwhec.errors import PriorError
from gtsam_rwhec.files.terminal_text import brief
from gtsam_rwhec.geometry.poses import Array, PoseLike, one_transform
from gtsam_rwhec.geometry.quaternions import conjugate, left, to_rotations
from gtsam_rwhec.geometry.real_numbers import is_between, is_one_of
from gtsam_rwhec.methods.dq_saddle import best_translation
from gtsam_rwhec.methods.dual_quaternion_cost import DualQuaternionCost, from_transforms, times_vectors
from gtsam_rwhec.methods.motions import LARGEST, Motions
from gtsam_rwhec.solver.free_directions import FreeDirection, FreeKind, FreeReason
from gtsam_rwhec.solver.noise_bounds import free_threshold

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


ScaleMode = Literal["known", "unknown"]


@dataclass(frozen=True)
class Request:
    """A problem C_i X = X H_i and how to solve it."""

    motions: Motions  #: C and H, checked
    #: Eq. 8 with alpha, with weights or covariances, and with the prior (eqs. 26-29) if there is one.
    cost: DualQuaternionCost
    alpha: float  #: Weight of translations relative to rotations, 1/m
    weights: Array | None  #: (N,): factor of each motion's terms
    covariances: Array | None  #: (N, 8, 8) or (1, 8, 8): of the residuals (A q, B q + A q')
    prior: DualQuaternionPrior | None  #: A pose known beforehand
    scale: ScaleMode  #: Whether t_C is in metres
    rng: np.random.Generator | int | None  #: For methods with a random start: ``numpy.random.default_rng(rng)``.


#: Information below this part of the largest is rounding error.
ROUNDING = 1e-12
#: The step (rad) of the finite difference that gives the translation's change with a rotation.
STEP_RAD = 1e-5


def free_directions(request: Request, q: Array, values: Array, vectors: Array) -> tuple[FreeDirection, ...]:
    """Free directions of the answer q (4,), as right perturbations of T_c_h; what a prior fixes is not free.

    ``values`` (4,) are the eigenvalues of Z(mu*), ascending, ``vectors`` (4, 4) its eigenvectors.
    """
    cost, V = request.cost, times_vectors(q)
    of_t, directions = np.linalg.eigh(V.T @ cost.M @ V)  # q' = (t / 2, 0) (x) q
    of_prior = 0.0 if request.prior is None else request.prior.b  # the prior adds to M without noise
    noise = max(float(q @ cost.M @ q) - of_prior, 0.0)
    threshold = _threshold(cost.count)
    moves = directions[:, of_t <= threshold * noise + ROUNDING * of_t[2]]
    noise = max(float(values[0]), 0.0)
    free = values[1:] <= threshold * noise + ROUNDING * np.trace(cost.S)
    turns = 2.0 * V.T @ vectors[:, 1:][:, free]  # q_a = (omega / 2, 0) (x) q: a turn in c's axes
    return _records(request, q, turns, moves)


def free_of_rotations_alone(request: Request) -> tuple[FreeDirection, ...]:
    """Free directions of a method that takes the rotation from the rotations alone, or nearly (DQ2Steps, Dan).

    Where the axes differ by no more than their noise, the rotation about the common axis is free, and so is the
    translation along it.
    """
    values, vectors = request.cost.spectrum
    limit = _threshold(request.cost.count) * max(float(values[0]), 0.0) + ROUNDING * values[3]
    q = vectors[:, 0]
    turns = times_vectors(q).T @ vectors[:, 1:][:, values[1:] <= limit]
    return _records(request, q, turns, turns)


def _threshold(count: int) -> float:
    """A direction is free up to this information, divided by the noise along the answer.

    The fit makes the noise along the answer smaller by the factor (count - 1) / count. The threshold corrects this.
    """
    return float(free_threshold(3.0 * count, 0.0, 3.0 * (count - 1.0))) * count / (count - 1.0)


def _records(request: Request, q: Array, turns: Array, moves: Array) -> tuple[FreeDirection, ...]:
    """One record for each turn (3, k) and each translation (3, m), both in c's axes."""
    if not turns.size and not moves.size:
        return ()
    reason = {0: FreeReason.NOISE, 1: FreeReason.ONE_AXIS}.get(moves.shape[1], FreeReason.NO_ROTATION)
    R_h_c, length_m, V = to_rotations(q).T, 1.0 / request.alpha, times_vectors(q)
    records = []
    for axis in turns.T / np.linalg.norm(turns, axis=0)[:, None]:
        ahead, behind = (best_translation(request.cost, q + s * 0.5 * V @ axis) for s in (STEP_RAD, -STEP_RAD))
        xi = np.concatenate([R_h_c @ axis, R_h_c @ (ahead - behind) / (2.0 * STEP_RAD * length_m)])
        records.append((FreeKind.ROTATION, xi / np.linalg.norm(xi)))
    records += [(FreeKind.TRANSLATION, np.concatenate([np.zeros(3), R_h_c @ axis])) for axis in moves.T]
    metric = np.repeat([1.0, length_m], 3)
    return tuple(
        FreeDirection(kind=kind, reason=reason, frames={"h": tuple((metric * xi).tolist())}, length_m=length_m)
        for kind, xi in records
    )
