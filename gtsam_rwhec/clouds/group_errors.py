"""Errors that groups of views have together, which edges alone tell little of: found by the carriers' poses, too."""

from __future__ import annotations

import numpy as np
from rwhec_factors import se3

from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.problem.directions import SEEN

#: Views are loose together where so many times the variance of each among the others is not known.
LOOSE = 1.3
#: Rounding, in shares of what each view among the others knows.
NOTHING = 1e-9
#: A fit of some numbers ends with a step that is this small beside their deviations.
SETTLED, MOST_STEPS = 1e-6, 20


def of_groups(poses: Array, i: np.ndarray, j: np.ndarray, information: Array, unit: Array) -> Array:
    """How errors that groups of views have together move them, (N, 6, m), beyond what each view tells beside the others.

    The views of one side of a box know each other well, and those of the other side little: its width is told by edges
    alone. With C the covariance of all poses and D that of each view among the others, D^-1/2 C D^-1/2 then has large
    eigenvalues. Where they are at most ``LOOSE``, nothing is added.
    """
    N = len(unit)
    T_i_j = se3.inverse(poses[i]) @ poses[j]
    to = np.concatenate([-se3.adjoint(se3.inverse(T_i_j)) @ unit[i], unit[j]], axis=2)
    parts = to.transpose(0, 2, 1) @ information @ to
    whole = np.zeros((N, N, 6, 6))
    for rows, a in ((slice(0, 6), i), (slice(6, 12), j)):
        for columns, b in ((slice(0, 6), i), (slice(6, 12), j)):
            np.add.at(whole, (a, b), parts[:, rows, columns])
    values, along = np.linalg.eigh(whole[np.arange(N), np.arange(N)])
    known_at_all = values > SEEN * values[:, -1:]
    roots = along * np.where(known_at_all, np.abs(values), np.inf)[:, None, :] ** -0.5
    white = np.einsum("aki,abkl,blj->aibj", roots, whole, roots).reshape(6 * N, 6 * N)
    # All views together may be anywhere: the thing's own pose is free.
    anywhere = np.sqrt(np.where(known_at_all, values, 0.0))[:, :, None] * (
        along.transpose(0, 2, 1) @ np.linalg.solve(unit, se3.adjoint(se3.inverse(poses)))
    )
    free = np.linalg.svd(anywhere.reshape(6 * N, 6), full_matrices=False)[0]
    told, modes = np.linalg.eigh(white + free @ free.T)
    loose = (told > NOTHING) & (told < 1.0 / LOOSE)
    w = modes[:, loose].reshape(N, 6, -1)
    return np.asarray(unit @ roots @ w * np.sqrt(1.0 / told[loose] - 1.0))


def fitted(A: Array, B: Array, covariances: Array, groups: Array, of_A: Array, Y: Array) -> tuple[Array, Array]:
    """Poses of a thing without the errors that groups of views have together, and how what is left of these moves Y.

    A X exp(x) = Y exp(y) exp(n) B exp(G z + b): n has the variances ``of_A`` (6,), b the covariances of B (N, 6, 6), and
    z, by which G (N, 6, m) moves the views, 1 each. Least squares has them all, and B exp(G z) is given. At this z, Y
    lacks of its covariance the squares of its moves (6, 6) by the uncertainty of z.
    """
    z, X = np.zeros(groups.shape[2]), se3.inverse(A[:1])[0] @ Y @ B[0]
    for _ in range(MOST_STEPS):
        M = B @ se3.expmap(groups @ z)
        back = se3.adjoint(se3.inverse(M))
        residual = se3.logmap(se3.inverse(M) @ se3.inverse(Y) @ A @ X)
        J = np.concatenate([-back, np.broadcast_to(np.eye(6), back.shape), -groups], axis=2)
        weighted = np.linalg.solve(covariances + back * of_A @ back.transpose(0, 2, 1), J)
        information = np.einsum("nia,nib->ab", J, weighted)
        information[12:, 12:] += np.eye(len(z))
        gradient = np.einsum("nia,ni->a", weighted, residual) + np.r_[np.zeros(12), z]
        known = np.linalg.pinv(information, hermitian=True)
        step = -known @ gradient
        Y, X = Y @ se3.expmap(step[None, :6])[0], X @ se3.expmap(step[None, 6:12])[0]
        z = z + step[12:]
        if np.abs(information @ step @ step) < SETTLED**2:
            break
    by_z = np.linalg.pinv(information[:12, :12], hermitian=True)[:6] @ information[:12, 12:]
    values, along = np.linalg.eigh(by_z @ known[12:, 12:] @ by_z.T)
    return B @ se3.expmap(groups @ z), along * np.sqrt(np.maximum(values, 0.0))
