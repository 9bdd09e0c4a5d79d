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


def _groups(stated: np.ndarray) -> Array:
    """Ones (g, m) at the sensors of each noise that is estimated: two sensors without stated noise share one."""
    if len(stated) == 2 and not stated.any():
        return np.ones((1, 2))
    groups: Array = np.eye(len(stated))[~stated]
    return groups


def _by_logarithm(groups: Array, variances: Array) -> Array:
    """Derivatives (2 g, 2 m) of all variances (m, 2) by the logarithms of each group's."""
    derivatives: Array = np.einsum("gm,mc,cd->gcmd", groups, variances, np.eye(2))
    return derivatives.reshape(2 * len(groups), variances.size)


def _unit(scale: Array) -> Array:
    """The units (m, 2) of the variances: a translation's is the metric variance times the sensor's scale squared."""
    unit: Array = np.c_[np.ones(len(scale)), scale**2]
    return unit


def found_variances(
    windows: WindowMotions, linear: Linear, variances: Array, stated: np.ndarray, scale: Array, unknowns: int
) -> Array:
    """Variances (m, 2) of rotation (rad^2/s) and translation (m^2/s), from the residuals at a solution.

    ``variances`` (m, 2) are the initial values; those of sensors with ``stated`` noise (m,) do not change. The
    translation variance of a sensor of unknown scale is in its own unit of length; ``scale`` (m,) converts it.
    """
    groups, unit = _groups(stated), _unit(scale)
    if not len(groups) or not len(windows):
        return variances
    parts = np.array(windows.covariance_parts())  # (2, m, n, 6, 6)
    current = variances / unit
    equations = 6.0 * float((windows.used.sum(axis=0) - 1).sum())
    taken = equations / max(equations - unknowns, 1.0)
    members = groups / groups.sum(axis=1, keepdims=True)
    previous = np.log(current)
    limit = 2.0 * np.log(LARGEST_CHANGE)
    for _ in range(ROUNDS):
        W = weights(windows, *(current * unit).T)
        score, information = _score(windows, linear, W, parts, unit, taken)
        select = _by_logarithm(groups, current)
        gradient = select @ score.ravel() - (members @ (np.log(current) - previous)).ravel() / PRIOR**2
        curvature = select @ information @ select.T + np.eye(len(select)) / PRIOR**2
        step = np.clip(np.linalg.solve(curvature, gradient), -limit, limit).reshape(-1, 2)
        current = current * np.exp(groups.T @ step)
        if np.abs(step).max() < CONVERGED:
            break
    return current * unit


def uncertain_by(windows: WindowMotions, linear: Linear, variances: Array, stated: np.ndarray, scale: Array) -> Array:
    """Standard deviations (m, 2) of the logarithms of the estimated variances; zero where they were stated.

    Among several sensors, the noise of the best one is small against the others' and is poorly known.
    """
    groups, unit = _groups(stated), _unit(scale)
    parts = np.array(windows.covariance_parts())
    _, information = _score(windows, linear, weights(windows, *variances.T), parts, unit, 1.0)
    select = _by_logarithm(groups, variances / unit)
    inverse = np.linalg.inv(select @ information @ select.T + np.eye(len(select)) / PRIOR**2)
    return groups.T @ np.sqrt(np.diagonal(inverse)).reshape(-1, 2)


def _contrasts(linear: Linear, W: Array) -> tuple[Array, Array, Array, Array]:
    """W B (m, n, 6, 6), (B' W B)^-1 (n, 6, 6), S r (m, n, 6), and the blocks S_kk (m, n, 6, 6)."""
    WB = W @ linear.B
    inner = np.linalg.inv(np.einsum("mnia,mnib->nab", linear.B, WB, optimize=True))
    Wr = np.einsum("mnij,mnj->mni", W, linear.r)
    fitted = np.einsum("nab,mnib,mni->na", inner, linear.B, Wr, optimize=True)
    Sr = Wr - np.einsum("mnia,na->mni", WB, fitted)
    return WB, inner, Sr, W - WB @ inner @ np.swapaxes(WB, 2, 3)


def _score(
    windows: WindowMotions, linear: Linear, W: Array, parts: Array, unit: Array, taken: float
) -> tuple[Array, Array]:
    """Score (m, 2) and expected information (2 m, 2 m) of the variances, over all windows."""
    m = windows.sensors
    WB, inner, Sr, S_own = _contrasts(linear, W)
    parts = parts * unit.T[:, :, None, None, None]
    squares = taken * np.einsum("mni,cmnij,mnj->mc", Sr, parts, Sr, optimize=True)
    # S V_c has the blocks S_jk V_c,k; its trace needs S_kk.
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
    _, _, u, S = _contrasts(linear, W)
    alone = np.abs(np.einsum("mnii->mn", S)) <= 1e-9 * np.einsum("mnii->mn", W)
    S[alone] = np.eye(6)
    u[alone] = 0.0
    # With two sensors S_kk still has full rank. It is scaled to a unit diagonal, as its units (rad, m) differ.
    unit = 1.0 / np.sqrt(np.maximum(np.einsum("mnii->mni", S), 1e-300))
    scaled = S * unit[..., :, None] * unit[..., None, :] + 1e-9 * np.eye(6)
    squares: Array = np.einsum("mni,mni->mn", u * unit, np.linalg.solve(scaled, (u * unit)[..., None])[..., 0])
    return squares


def outlying(windows: WindowMotions, linear: Linear, W: Array, noise_is_known: np.ndarray) -> np.ndarray:
    """Where to leave a sensor's window out, (m, n) booleans: at most the worst sensor of each window.

    The squares are compared with each sensor's median. Where ``noise_is_known`` (m,), the median only raises the limit.
    """
    squares = deletion_squares(linear, W)
    squares[~windows.used] = 0.0
    medians = np.array(
        [np.median(own[used]) if used.any() else MEDIAN for own, used in zip(squares, windows.used, strict=True)]
    )
    factor = np.maximum(medians / MEDIAN, np.where(noise_is_known, 1.0, 1e-3))
    relative = squares / (factor * float(chdtri(6.0, SIGNIFICANCE)))[:, None]
    worst = relative == relative.max(axis=0)
    left_out: np.ndarray = worst & (relative > 1.0)
    return left_out
