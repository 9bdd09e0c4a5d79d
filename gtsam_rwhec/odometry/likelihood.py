"""The likelihood of all sensors' motions, with the vehicle's own motion eliminated window by window (design fact 24).

Sensor k's motion over a window is M_k = T_k^-1 M T_k, with its translation times its scale; M is the motion of sensor 0
and a nuisance. To first order in perturbations T_k Expmap(x), M Expmap(d):

    r_k = Log(M_k^-1 measured),   r_k + J_k x + B_k d = noise,   J_k = -S (I - Ad(M_k^-1)),   B_k = -S Ad(T_k^-1)

with S the scale on the translations' rows. The code has J and B with the opposite sign: what a step takes from r.

The information H after the elimination holds what the noise of M's estimate adds, since J is evaluated there: the
expected value of that part is N. So H - N is the information that the motion gives, and with it the covariance of the
maximum of the likelihood is (H - N)^-1 H (H - N)^-1, as for total least squares.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from rwhec_factors import se3

from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.odometry.unknowns import OFFSET, SCALE, Layout, State
from gtsam_rwhec.odometry.window_motions import WindowMotions


@dataclass(frozen=True)
class Linear:
    """Residuals and derivatives at a state.

    Attributes
    ----------
    r : (m, n, 6) array
    J : (m, n, 6, 8) array
        By the sensor's own columns (`unknowns.COLUMNS`).
    B : (m, n, 6, 6) array
        By the window's motion.
    """

    r: Array
    J: Array
    B: Array


@dataclass(frozen=True)
class Eliminated:
    """The normal equations after the elimination of the windows' motions.

    Attributes
    ----------
    H : (p, p) array
    g : (p,) array
        The step is H^-1 g.
    G : (n, 6, p) array
        sum_k B' W J of each window.
    D : (n, 6, 6) array
        sum_k B' W B of each window.
    of_motion : (n, 6) array
        sum_k B' W r.
    cost : float
        Half the weighted squares of the residuals.
    """

    H: Array
    g: Array
    G: Array
    D: Array
    of_motion: Array
    cost: float

    def motions(self, step: Array) -> Array:
        """The motions' step (n, 6) that goes with a step of the unknowns."""
        d: Array = np.linalg.solve(self.D, (self.of_motion - self.G @ step)[:, :, None])[:, :, 0]
        return d


def weights(windows: WindowMotions, rotation: Array, translation: Array) -> Array:
    """The inverse covariances (m, n, 6, 6) of the windows for variances a second (m,); zero where one is not used."""
    inverse: Array = np.linalg.inv(covariances(windows, rotation, translation)) * windows.used[:, :, None, None]
    return inverse


def covariances(windows: WindowMotions, rotation: Array, translation: Array) -> Array:
    """The covariances (m, n, 6, 6) of the windows for variances a second (m,); the identity where one is not used."""
    of_rotation, of_translation = windows.covariance_parts()
    covariance = rotation[:, None, None, None] * of_rotation + translation[:, None, None, None] * of_translation
    covariance[~windows.used] = np.eye(6)
    return covariance


def predicted(state: State) -> Array:
    """The motions (m, n, 4, 4) that the sensors should measure."""
    M = se3.inverse(state.T)[:, None] @ state.motion @ state.T[:, None]
    M[..., :3, 3] *= state.scale[:, None, None]
    return M


def linearised(windows: WindowMotions, state: State) -> Linear:
    """Residuals and derivatives."""
    m, n = windows.used.shape
    M = predicted(state)
    r = se3.logmap((se3.inverse(M) @ windows.M).reshape(m * n, 4, 4)).reshape(m, n, 6)
    r = r + windows.by_offset * state.offset[:, None, None]
    true = M.copy()
    true[..., :3, 3] /= state.scale[:, None, None]
    J = np.zeros((m, n, 6, 8))
    J[..., :6] = np.eye(6) - se3.adjoint(se3.inverse(true.reshape(m * n, 4, 4))).reshape(m, n, 6, 6)
    B = np.broadcast_to(se3.adjoint(se3.inverse(state.T))[:, None], (m, n, 6, 6)).copy()
    for each in (J, B):
        each[..., 3:, :] *= state.scale[:, None, None, None]
    J[..., 3:, SCALE] = np.einsum("mnji,mnj->mni", M[..., :3, :3], M[..., :3, 3])
    J[..., OFFSET] = -windows.by_offset
    return Linear(r, J, B)


def eliminated(linear: Linear, W: Array, layout: Layout) -> Eliminated:
    """Normal equations of the unknowns."""
    r, B = linear.r, linear.B
    J = linear.J * layout.open[:, None, None, :]
    WJ, WB, Wr = W @ J, W @ B, np.einsum("mnij,mnj->mni", W, r)
    D = np.einsum("mnia,mnib->nab", B, WB, optimize=True)
    of_motion = np.einsum("mnia,mni->na", B, Wr)
    G = _by_window(np.swapaxes(B, 2, 3) @ WJ, layout)
    H, g = _own(np.einsum("mnia,mnib->mab", J, WJ, optimize=True), layout), np.zeros(layout.size + 1)
    np.add.at(g, layout.at, np.einsum("mnia,mni->ma", J, Wr))
    DG = np.linalg.solve(D, G)
    H -= np.einsum("nap,naq->pq", G, DG, optimize=True)
    g = g[:-1] - np.einsum("nap,na->p", DG, of_motion)
    return Eliminated(0.5 * (H + H.T), g, G, D, of_motion, 0.5 * float((r * Wr).sum()))


def covariance_of_motions(linear: Linear, W: Array, D: Array, V: Array) -> Array:
    """The covariance (n, 6, 6) of the windows' estimated motions if the sensors' is V (m, n, 6, 6), whatever W says."""
    WB = W @ linear.B
    inverse = np.linalg.inv(D)
    covariance: Array = inverse @ np.einsum("mnia,mnij,mnjb->nab", WB, V, WB, optimize=True) @ inverse
    return covariance


def information_of_noise(linear: Linear, W: Array, layout: Layout, state: State, D: Array, of_motion: Array) -> Array:
    """N (p, p): what the noise of the windows' estimated motions, with covariance ``of_motion``, alone adds to H."""
    m, n = W.shape[:2]
    M = predicted(state)
    true = M.copy()
    true[..., :3, 3] /= state.scale[:, None, None]
    back = se3.adjoint(se3.inverse(true.reshape(m * n, 4, 4))).reshape(m, n, 6, 6)
    # The columns of a root of M's covariance, as each sensor sees them.
    root = np.linalg.cholesky(of_motion)
    twists = np.einsum("mij,nja->mnia", se3.adjoint(se3.inverse(state.T)), root)
    R_t = np.einsum("mnji,mnj->mni", true[..., :3, :3], true[..., :3, 3])
    N = np.zeros((layout.size, layout.size))
    for a in range(6):
        omega, v = twists[..., :3, a], twists[..., 3:, a]
        dJ = np.zeros((m, n, 6, 8))
        dJ[..., :6] = _ad(omega, v) @ back
        dJ[..., 3:, SCALE] = v - np.cross(omega, R_t)
        dJ[..., 3:, :] *= state.scale[:, None, None, None]
        dJ *= layout.open[:, None, None, :]
        WdJ = W @ dJ
        dG = _by_window(np.swapaxes(linear.B, 2, 3) @ WdJ, layout)
        N += _own(np.einsum("mnia,mnib->mab", dJ, WdJ, optimize=True), layout)
        N -= np.einsum("nap,naq->pq", dG, np.linalg.solve(D, dG), optimize=True)
    symmetric: Array = 0.5 * (N + N.T)
    return symmetric


def _by_window(blocks: Array, layout: Layout) -> Array:
    """(m, n, 6, 8) blocks as (n, 6, p), each in its sensor's columns."""
    G = np.zeros((blocks.shape[1], 6, layout.size + 1))
    for k in range(len(blocks)):
        G[:, :, layout.at[k]] += blocks[k]
    return G[:, :, :-1]


def _own(blocks: Array, layout: Layout) -> Array:
    """(m, 8, 8) blocks on the diagonal of (p, p)."""
    H = np.zeros((layout.size + 1, layout.size + 1))
    for k in range(len(blocks)):
        H[np.ix_(layout.at[k], layout.at[k])] += blocks[k]
    return H[:-1, :-1]


def _ad(omega: Array, v: Array) -> Array:
    """The matrices (..., 6, 6) with Ad(Expmap(x)) = I + ad(x) to first order."""
    shape = omega.shape[:-1]
    W, V = (se3.hat(x.reshape(-1, 3)).reshape(*shape, 3, 3) for x in (omega, v))
    result = np.zeros((*shape, 6, 6))
    result[..., :3, :3] = result[..., 3:, 3:] = W
    result[..., 3:, :3] = V
    return result
