"""Windows in which one sensor contradicts the others."""

from __future__ import annotations

import numpy as np
from scipy.special import chdtri

from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.odometry.likelihood import Linear
from gtsam_rwhec.odometry.window_motions import WindowMotions

#: The probability that a window without fault is left out.
SIGNIFICANCE = 1e-5
#: The median of chi-square with six degrees of freedom.
MEDIAN = 5.348


def deletion_squares(linear: Linear, W: Array) -> Array:
    """(m, n) by how much twice the cost falls if a sensor's window is left out: chi-square with six degrees.

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
    # Of two sensors S_kk has full rank; rounding is relative to its entries of rad and m.
    unit = 1.0 / np.sqrt(np.maximum(np.einsum("mnii->mni", S), 1e-300))
    scaled = S * unit[..., :, None] * unit[..., None, :] + 1e-9 * np.eye(6)
    squares: Array = np.einsum("mni,mni->mn", u * unit, np.linalg.solve(scaled, (u * unit)[..., None])[..., 0])
    return squares.reshape(m, n)


def outlying(windows: WindowMotions, linear: Linear, W: Array, noise_is_known: np.ndarray) -> np.ndarray:
    """(m, n) the windows of sensors that are to be left out: the worst sensor of each window that has one.

    Where a sensor's noise is not known (m,), its median square stands for it.
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
