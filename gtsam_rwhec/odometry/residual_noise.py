"""The noise of odometries, found by restricted likelihood of their residuals against one another.

The windows' motions are unknown, so only differences between sensors (contrasts) carry information. With three sensors
the noise of each can be found; with two only the sum, and both are taken as equally noisy. V is the covariance of all
sensors' residuals of a window, B their derivative with respect to its motion, and
S = V^-1 - V^-1 B (B' V^-1 B)^-1 B' V^-1. With V_c = dV / dv_c, the score of a variance v_c is
(r' S V_c S r - tr S V_c) / 2, and the information is tr(S V_c S V_d) / 2 (Patterson and Thompson 1971). The p unknowns
of the poses use up p equations; the residuals are scaled up for this.
"""

from __future__ import annotations

import numpy as np
from scipy.special import chdtri

from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.odometry.window_likelihood import Linear, weights
from gtsam_rwhec.odometry.window_motions import WindowMotions

#: A step changes a standard deviation at most by this factor.
LARGEST_CHANGE = 3.0
#: Scoring has converged when no variance changes by more than this part.
CONVERGED = 1e-3
#: Rounds of scoring at one linearisation.
ROUNDS = 30
#: Standard deviation of a prior on each log variance, which holds variances that the data do not determine.
PRIOR = 4.0


def groups_of(stated: np.ndarray) -> np.ndarray:
    """The noise group (m,) of each sensor: each has its own; two sensors without stated noise share one."""
    groups = np.arange(len(stated))
    if len(stated) == 2 and not stated.any():
        groups[:] = 0
    return groups


def found_variances(
    windows: WindowMotions, linear: Linear, variances: Array, stated: np.ndarray, scale: Array, unknowns: int
) -> Array:
    """Variances (m, 2) of rotation (rad^2/s) and translation (m^2/s), from the residuals at a solution.

    ``variances`` (m, 2) are the initial values; those of sensors with ``stated`` noise (m,) do not change. The
    translation variance of a sensor of unknown scale is in its own unit of length; ``scale`` (m,) converts it.
    """
    m, n = windows.used.shape
    parts = np.array(windows.covariance_parts())  # (2, m, n, 6, 6)
    groups = groups_of(stated)
    names = [group for group in np.unique(groups) if not stated[groups == group].all()]
    if not names or n == 0:
        return variances
    # A sensor's translation variance is the metric variance times its scale squared.
    unit = np.ones((m, 2))
    unit[:, 1] = scale**2
    current = variances / unit
    equations = 6.0 * float((windows.used.sum(axis=0) - 1).sum())
    taken = equations / max(equations - unknowns, 1.0)
    previous = np.log(current.copy())
    for _ in range(ROUNDS):
        W = weights(windows, *(current * unit).T)
        score, information = _score(windows, linear, W, parts, unit, taken)
        # by the logarithm of each group's variance
        rows = np.array([[np.where((groups == g), current[:, c], 0.0) for c in range(2)] for g in names]).reshape(-1, m)
        component = np.tile([0, 1], len(names))
        by_sensor = np.zeros((len(rows), m, 2))
        by_sensor[np.arange(len(rows)), :, component] = rows
        select = by_sensor.reshape(len(rows), 2 * m)
        gradient = select @ score.ravel()
        curvature = select @ information @ select.T
        first = [np.argmax(groups == g) for g in names]
        deviation = np.array([np.log(current[f, c]) - previous[f, c] for f in first for c in range(2)])
        gradient -= deviation / PRIOR**2
        curvature += np.eye(len(rows)) / PRIOR**2
        limit = 2.0 * np.log(LARGEST_CHANGE)
        step = np.clip(np.linalg.solve(curvature, gradient), -limit, limit).reshape(-1, 2)
        for g, change in zip(names, step, strict=True):
            current[groups == g] *= np.exp(change)
        if np.abs(step).max() < CONVERGED:
            break
    result: Array = current * unit
    return result


def uncertain_by(windows: WindowMotions, linear: Linear, variances: Array, stated: np.ndarray, scale: Array) -> Array:
    """Standard deviations (m, 2) of the logarithms of the estimated variances; zero where they were stated.

    Among several sensors, the noise of the best one is small against the others' and is poorly known.
    """
    m = windows.sensors
    unit = np.ones((m, 2))
    unit[:, 1] = scale**2
    parts = np.array(windows.covariance_parts())
    _, information = _score(windows, linear, weights(windows, *variances.T), parts, unit, 1.0)
    own = (variances / unit).ravel()
    groups = groups_of(stated)
    open_ones = np.flatnonzero(~stated)
    deviation = np.zeros((m, 2))
    if not len(open_ones):
        return deviation
    shared = bool((groups == groups[0]).all())
    at = np.array([[2 * k, 2 * k + 1] for k in open_ones]).ravel()
    by_log = own[:, None] * information * own
    if shared:  # two sensors with one noise
        both = by_log.reshape(m, 2, m, 2).sum(axis=(0, 2))
        deviation[:] = np.sqrt(np.diagonal(np.linalg.inv(both + np.eye(2) / PRIOR**2)))
        return deviation
    inverse = np.linalg.inv(by_log[np.ix_(at, at)] + np.eye(len(at)) / PRIOR**2)
    deviation[open_ones] = np.sqrt(np.diagonal(inverse)).reshape(-1, 2)
    return deviation


def _score(
    windows: WindowMotions, linear: Linear, W: Array, parts: Array, unit: Array, taken: float
) -> tuple[Array, Array]:
    """Score (m, 2) and expected information (2 m, 2 m) of the variances, over all windows."""
    m = windows.sensors
    WB = W @ linear.B
    inner = np.linalg.inv(np.einsum("mnia,mnib->nab", linear.B, WB, optimize=True))
    parts = parts * unit.T[:, :, None, None, None]
    Wr = np.einsum("mnij,mnj->mni", W, linear.r)
    fitted = np.einsum("nab,mnib,mni->na", inner, linear.B, Wr, optimize=True)
    Sr = Wr - np.einsum("mnia,na->mni", WB, fitted)
    squares = taken * np.einsum("mni,cmnij,mnj->mc", Sr, parts, Sr, optimize=True)
    # S V_c has the blocks S_jk V_c,k; its trace needs S_kk.
    S_own = W - WB @ inner @ np.swapaxes(WB, 2, 3)
    traces = np.einsum("mnij,cmnji->mc", S_own, parts, optimize=True)
    information = np.zeros((m, 2, m, 2))
    for j in range(m):
        for k in range(j, m):
            S = S_own[j] if j == k else -WB[j] @ inner @ np.swapaxes(WB[k], 1, 2)
            left = [parts[c, j] @ S for c in range(2)]
            right = [parts[c, k] @ np.swapaxes(S, 1, 2) for c in range(2)]
            for c in range(2):
                for d in range(2):
                    value = 0.5 * float(np.einsum("nij,nji->", left[c], right[d]))
                    information[j, c, k, d] = information[k, d, j, c] = value
    return 0.5 * (squares - traces), information.reshape(2 * m, 2 * m)


#: The probability that a correct window is left out.
SIGNIFICANCE = 1e-5
#: The median of chi-square with six degrees of freedom.
MEDIAN = 5.348


def deletion_squares(linear: Linear, W: Array) -> Array:
    """Twice the fall of the cost (m, n) if a sensor's window is left out: chi-square with six degrees of freedom.

    With S the contrasts' information and u = S r, a sensor's part u_k has the covariance S_kk.
    """
    m, n = W.shape[:2]
    WB = W @ linear.B
    inner = np.linalg.inv(np.einsum("mnia,mnib->nab", linear.B, WB, optimize=True))
    Wr = np.einsum("mnij,mnj->mni", W, linear.r)
    u = Wr - np.einsum("mnia,na->mni", WB, np.einsum("nab,mnib,mni->na", inner, linear.B, Wr, optimize=True))
    S = W - WB @ inner @ np.swapaxes(WB, 2, 3)
    alone = np.abs(np.einsum("mnii->mn", S)) <= 1e-9 * np.einsum("mnii->mn", W)
    S[alone] = np.eye(6)
    u[alone] = 0.0
    # With two sensors S_kk still has full rank. It is scaled to a unit diagonal, as its units (rad, m) differ.
    unit = 1.0 / np.sqrt(np.maximum(np.einsum("mnii->mni", S), 1e-300))
    scaled = S * unit[..., :, None] * unit[..., None, :] + 1e-9 * np.eye(6)
    squares: Array = np.einsum("mni,mni->mn", u * unit, np.linalg.solve(scaled, (u * unit)[..., None])[..., 0])
    return squares.reshape(m, n)


def outlying(windows: WindowMotions, linear: Linear, W: Array, noise_is_known: np.ndarray) -> np.ndarray:
    """Where to leave a sensor's window out, (m, n) booleans: at most the worst sensor of each window.

    The squares are compared with each sensor's median. Where ``noise_is_known`` (m,), the median only raises the limit.
    """
    squares = deletion_squares(linear, W)
    squares[~windows.used] = 0.0
    factor = np.ones(windows.sensors)
    for k in range(windows.sensors):
        if windows.used[k].any():
            factor[k] = max(float(np.median(squares[k, windows.used[k]])) / MEDIAN, 1.0 if noise_is_known[k] else 1e-3)
    relative = squares / (factor * float(chdtri(6.0, SIGNIFICANCE)))[:, None]
    worst = relative == relative.max(axis=0)
    left_out: np.ndarray = worst & (relative > 1.0)
    return left_out
