"""A lower bound on the smallest eigenvalue of a nearly singular Z_rr, far tighter than a verified test of all of Z_rr.

Let V (N, k) be approximate eigenvectors of the smallest eigenvalues and M = Z + c V V' >= m > 0, verified with room.
Any z is V a + w with V'w = 0, so w'Zw = w'Mw >= m |w|^2. With R = Z V - V diag(lambda), w'Z V a is w'R a. Hence::

    z'Zz >= a'(V'ZV)a - 2 |a| |R| |w| + m |w|^2 >= -(nu + |R|^2 / m) |a|^2,      |a|^2 <= |z|^2 / (1 - |V'V - I|)

Here -nu is a lower bound on the eigenvalues of V'ZV (by Gershgorin, as V'ZV is nearly diagonal). V'ZV and R are
evaluated in extended precision. The term |R|^2 is there because V is only approximate.
"""

from __future__ import annotations

import numpy as np
import scipy.linalg

from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.solver.lagrangian import WIDE_UNIT, Wide, lagrangian
from gtsam_rwhec.solver.reduced_form import ReducedForm
from gtsam_rwhec.solver.verified import cholesky_allowance, gamma, is_positive_definite

#: Eigenvectors are removed if their eigenvalue is below this many times the verified test's allowance for rounding
#: errors.
REACH = 100.0
#: A bound times this factor covers the rounding errors of the few operations that compute it.
_SAFETY = 1.0 + 1e-9


def deflated_eigenvalue(
    form: ReducedForm, multipliers: Array, arrow_part: Array, rounded: Array, slack: Array
) -> float:
    """A proven lower bound on the smallest eigenvalue of Z_rr; minus infinity when nothing is proven.

    ``multipliers`` (n, 20); ``arrow_part`` (9 n, 9 n): Z_rr before G'G is subtracted; ``rounded`` (9 n,): a diagonal
    that dominates its rounding; ``slack`` (n, 9): the verified test's allowance, which cannot tell smaller eigenvalues
    from zero.
    """
    N = len(arrow_part)
    G = form.G[:, :-1]
    Z = arrow_part - G.T @ G
    Z = 0.5 * (Z + Z.T)
    values, vectors = scipy.linalg.eigh(Z, check_finite=False)
    taken = values <= REACH * float(slack.max())
    V, of_V = vectors[:, taken], values[taken]
    k = V.shape[1]
    if k == 0 or k == N:
        return -np.inf

    # M - m > 0, with the rounding in M subtracted too.
    c = float(np.abs(np.diagonal(Z)).max())
    M = Z + c * (V @ V.T)
    of_G, of_V_rows = np.abs(G), np.abs(V)
    formed = gamma(len(G) + 6) * (of_G.T @ of_G.sum(axis=1)) + gamma(k + 6) * c * (of_V_rows @ of_V_rows.sum(axis=0))
    formed += 8.0 * gamma(1) * np.abs(M).sum(axis=1) + 8.0 * gamma(1) * np.abs(arrow_part).sum(axis=1)
    room = cholesky_allowance(np.diagonal(M), N)
    if not is_positive_definite(M, room + rounded + _SAFETY * formed):
        return -np.inf

    # V'ZV and the residual, column by column in extended precision.
    ZV = np.empty((N, k), dtype=Wide)
    errors = np.empty((N, k))
    for j in range(k):
        _, Zv, _, error = lagrangian(form, multipliers, np.append(V[:, j], 0.0))
        ZV[:, j], errors[:, j] = Zv[:-1], error[:-1]
    wide_V = V.astype(Wide)
    H = wide_V.T @ ZV
    of_ZV = np.abs(ZV).astype(float) * _SAFETY
    H_error = (of_V_rows.T @ errors) * _SAFETY + gamma(N + 2, WIDE_UNIT) * (of_V_rows.T @ of_ZV)
    size_H = np.abs(H).astype(float) * _SAFETY + H_error
    diagonal = np.diagonal(H).astype(float)
    diagonal = diagonal - 4.0 * gamma(1) * np.abs(diagonal) - np.diagonal(H_error)
    radius = (size_H - np.diag(np.diagonal(size_H))).sum(axis=1) * _SAFETY
    nu = max(0.0, float((radius + np.diagonal(H_error) - diagonal).max()))
    residual = np.abs(ZV - wide_V * of_V).astype(float) * _SAFETY + errors
    residual += gamma(3, WIDE_UNIT) * (of_ZV + of_V_rows * np.abs(of_V))
    rho_squared = float((residual**2).sum()) * _SAFETY
    off = float(np.abs(V.T @ V - np.eye(k)).sum()) + k * k * gamma(N + 2)
    if off >= 0.5:
        return -np.inf
    return float(-_SAFETY * (nu + rho_squared / float(room.min())) / (1.0 - off))
