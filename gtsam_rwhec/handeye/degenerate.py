"""Free directions of AX = XB: what the motions do not determine.

Noise in the measurements looks like motion, so real data never leave a direction exactly undetermined. As in
``solver.identification``, a direction is free when it has not significantly more information than noise alone
would create there. That noise is known from the answer:

- With noise delta q_C, delta q_H, A_i has E |A_i p|^2 = E |delta q_C|^2 + E |delta q_H|^2 for *every* unit p, since L
  and R of a unit quaternion are rotations. At the answer the signal's part of A q is zero. So |A q|^2 is that noise,
  and A'A has it in every direction. t enters as A q' (eq. 7), so its information is that of A'A.
- The same holds for the whole residual: at the best q, q'Z q = lambda comes from noise alone, and noise adds as
  much for every other q. The information about the rotation is in the eigenvalues of Z(mu*).

In each direction N motions sum 3 N squares of noise. The fit uses up 6 of the 6 N equations.
"""

from __future__ import annotations

import numpy as np

from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.geometry.quaternions import to_rotations
from gtsam_rwhec.handeye.dual_quaternions import times_vectors
from gtsam_rwhec.handeye.request import Request
from gtsam_rwhec.handeye.saddle import best_translation
from gtsam_rwhec.solver.free_directions import FreeDirection, FreeKind, FreeReason
from gtsam_rwhec.solver.noise_bounds import free_threshold

#: Information below this part of the largest is rounding error.
ROUNDING = 1e-12
#: A finite difference with this step (rad) tells how the translation follows a turn.
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
