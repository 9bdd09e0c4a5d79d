"""What the motions leave undetermined in AX = XB, and what can be solved all the same.

Noise in the measurements looks like motion, so nothing is ever exactly undetermined on real data. A direction is
called free when its information is at most twice what the residuals' noise alone would put there:

- A_i of noise delta q_C, delta q_H has E |A_i p|^2 = E |delta q_C|^2 + E |delta q_H|^2 for *every* unit p, since L
  and R of a unit quaternion are rotations. At the answer the signal's part of A q is zero, so |A q|^2 is that noise,
  and A'A has this noise in every direction: t, which enters as A q' (eq. 7), is free along directions in which A'A is
  at most twice q'A'A q, the signal at most the noise.
- The same of the whole residual: lambda is what noise makes of q'Z q for the best q, and so for every q; the rotation
  is free along eigenvectors of Z(mu*) whose eigenvalue is at most twice lambda.
"""

from __future__ import annotations

import numpy as np

from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.handeye.cost import DualQuaternionCost
from gtsam_rwhec.handeye.dual_quaternions import times_vectors

#: Total over noise up to which a direction is free: signal and noise in equal parts.
SIGNAL_AND_NOISE = 2.0
#: Information below this part of the largest is rounding.
ROUNDING = 1e-12
#: A coordinate axis is called by its name within 8 degrees.
AXIS_COSINE = np.cos(np.radians(8.0))


def free_directions(
    cost: DualQuaternionCost, q: Array, values: Array, vectors: Array, prior_b: float = 0.0
) -> tuple[str, ...]:
    """Free directions in words, of the answer q (4,) with the eigensystem of Z(mu*).

    Parameters
    ----------
    cost : DualQuaternionCost
        Prior included: what it fixes is not free.
    q : (4,) array
    values, vectors : (4,), (4, 4) arrays
        Of Z(mu*), ascending.
    prior_b : float
        What of M is a prior's, and so no noise.
    """
    words = []
    scale = float(np.trace(cost.S))
    limit = SIGNAL_AND_NOISE * max(float(values[0]), 0.0) * _lost_to_fit(cost.count) + ROUNDING * scale
    if values[1] <= limit:
        # q_a = (omega / 2, 0) (x) q: a turn in c's axes.
        turns = times_vectors(q).T @ vectors[:, values <= limit]
        words.append(f"rotation about {axes_in_words(turns)} of c's axes")
    V = times_vectors(q)  # q' = (t / 2, 0) (x) q
    G = V.T @ cost.M @ V
    of_t, directions = np.linalg.eigh(G)
    limit = SIGNAL_AND_NOISE * max(float(q @ cost.M @ q) - prior_b, 0.0) * _lost_to_fit(cost.count) + ROUNDING * float(
        of_t[2]
    )
    if of_t[0] <= limit:
        words.append(f"translation along {axes_in_words(directions[:, of_t <= limit])} of c's axes")
    return tuple(words)


def free_of_rotations_alone(cost: DualQuaternionCost) -> tuple[str, ...]:
    """Free directions of a method that takes the rotation from the rotations alone, or nearly (DQ2Steps, Dan).

    Where the axes differ by no more than their noise, such a rotation about the common axis is noise, and so is the
    translation along it.
    """
    values, vectors = cost.spectrum
    limit = SIGNAL_AND_NOISE * max(float(values[0]), 0.0) * _lost_to_fit(cost.count) + ROUNDING * float(values[3])
    if values[1] > limit:
        return ()
    axes = axes_in_words(times_vectors(vectors[:, 0]).T @ vectors[:, values <= limit])
    return (
        f"rotation about {axes} of c's axes, by this method, which has it from the rotations alone",
        f"translation along {axes} of c's axes",
    )


def _lost_to_fit(count: int) -> float:
    # Three of a motion's rotation residuals are noise; three in all went into the fit.
    return count / (count - 1.0) if count > 1 else 1.0


def axes_in_words(directions: Array) -> str:
    """Axes (3, k) by name where they have one."""
    left, s, _ = np.linalg.svd(directions)
    rank = int((s > 0.5 * s[0]).sum())
    if rank >= 3:
        return "every axis"
    basis = left[:, :rank] if rank == 1 else left[:, 2:]
    axis = basis[:, 0] * np.sign(basis[np.abs(basis[:, 0]).argmax(), 0])
    name = "xyz"[int(np.abs(axis).argmax())] if np.abs(axis).max() > AXIS_COSINE else None
    x, y, z = np.round(axis, 2) + 0.0  # no -0.00
    word = name or f"({x:.2f}, {y:.2f}, {z:.2f})"
    return word if rank == 1 else f"all axes across {word}"
