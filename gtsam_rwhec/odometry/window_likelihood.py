"""The unknowns of a calibration of odometries, their columns, one state of them, and the likelihood around it."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from rwhec_factors import se3

from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.odometry.window_motions import WindowMotions

#: Columns of each sensor in the derivatives: pose (6), logarithm of the scale, time offset.
COLUMNS = 8
SCALE, OFFSET = 6, 7
#: Columns of the ground: tilts of its normal about two axes (rad), the height of sensor 0 (m).
GROUND = 3


@dataclass(frozen=True)
class Layout:
    """Which of a sensor's eight columns are unknowns, and where the ground's three are."""

    open: np.ndarray  #: (m, 8) booleans
    has_ground: bool

    @staticmethod
    def of(scaled: np.ndarray, *, clocks: bool, has_ground: bool) -> Layout:
        """The poses are in the frame of sensor 0; ``scaled`` (m,) marks the sensors of unknown scale."""
        is_open = np.ones((len(scaled), COLUMNS), dtype=bool)
        is_open[:, SCALE], is_open[:, OFFSET] = scaled, clocks
        is_open[0] = False
        return Layout(is_open, has_ground)

    @cached_property
    def size(self) -> int:
        """The number of unknowns."""
        return int(self.open.sum()) + GROUND * self.has_ground

    @cached_property
    def at(self) -> np.ndarray:
        """The index of the unknown of each sensor's column (m, 8); ``size`` where the column is not an unknown."""
        numbers = np.full(self.open.shape, self.size)
        numbers[self.open] = np.arange(int(self.open.sum()))
        return numbers

    @cached_property
    def ground(self) -> np.ndarray:
        """The indices of the ground's unknowns."""
        return np.arange(self.size - GROUND, self.size) if self.has_ground else np.arange(0)

    @cached_property
    def poses(self) -> np.ndarray:
        """The indices (m - 1, 6) of the poses' tangents."""
        return self.at[1:, :6]

    def spread(self, step: Array) -> Array:
        """A step (size,) arranged by sensor and column, (m, 8)."""
        by_column: Array = np.append(step, 0.0)[self.at]
        return by_column


@dataclass(frozen=True)
class State:
    """Values of all unknowns."""

    T: Array  #: (m, 4, 4): poses in the frame of sensor 0
    scale: Array  #: (m,): measured over true length
    offset: Array  #: (m,): what is to be added to the time offsets with which the windows were made, seconds
    motion: Array  #: (n, 4, 4): the motion of sensor 0 over each window
    tilt: Array  #: (2,): of the ground's normal, rad
    height: float  #: Of sensor 0 above the ground, metres

    @staticmethod
    def at(T: Array, scale: Array, windows: WindowMotions, height: float = 0.0) -> State:
        """The state at given poses and scales; each window's motion is from the first sensor that has the window."""
        m = len(T)
        motion = np.tile(np.eye(4), (len(windows), 1, 1))
        known = np.zeros(len(windows), dtype=bool)
        for k in np.argsort(scale != 1.0, kind="stable"):
            new = windows.used[k] & ~known
            M = windows.M[k, new].copy()
            M[:, :3, 3] /= scale[k]
            motion[new] = T[k] @ M @ se3.inverse(T[k][None])
            known |= new
        return State(T, scale, np.zeros(m), motion, np.zeros(2), height)

    def moved(self, layout: Layout, step: Array, of_motion: Array) -> State:
        """The state after a step of the unknowns (size,) and of the motions (n, 6)."""
        by_sensor = layout.spread(step)
        ground = step[layout.ground]
        return replace(
            self,
            T=self.T @ se3.expmap(by_sensor[:, :6]),
            scale=self.scale * np.exp(by_sensor[:, SCALE]),
            offset=self.offset + by_sensor[:, OFFSET],
            motion=self.motion @ se3.expmap(of_motion),
            tilt=self.tilt + ground[:2] if layout.has_ground else self.tilt,
            height=self.height + float(ground[2]) if layout.has_ground else self.height,
        )


@dataclass(frozen=True)
class Linear:
    """The windows' residuals and their derivatives at a state."""

    r: Array  #: (m, n, 6)
    J: Array  #: (m, n, 6, 8): by the sensor's own columns (`COLUMNS`)
    B: Array  #: (m, n, 6, 6): by the window's motion


@dataclass(frozen=True)
class Eliminated:
    """The normal equations after the elimination of the windows' motions."""

    H: Array  #: (p, p)
    g: Array  #: (p,): the step is H^-1 g
    G: Array  #: (n, 6, p): sum_k B' W J of each window
    D: Array  #: (n, 6, 6): sum_k B' W B of each window
    of_motion: Array  #: (n, 6): sum_k B' W r
    cost: float  #: Half the weighted squares of the residuals

    def motions(self, step: Array) -> Array:
        """The best step (n, 6) of the motions for a step of the unknowns."""
        return np.linalg.solve(self.D, (self.of_motion - self.G @ step)[:, :, None])[:, :, 0]


def weights(windows: WindowMotions, rotation: Array, translation: Array) -> Array:
    """The windows' inverse covariances (m, n, 6, 6) for variances per second (m,); zero for unused windows."""
    inverse: Array = np.linalg.inv(covariances(windows, rotation, translation)) * windows.used[:, :, None, None]
    return inverse


def covariances(windows: WindowMotions, rotation: Array, translation: Array) -> Array:
    """The windows' covariances (m, n, 6, 6) for variances per second (m,); the identity for unused windows."""
    of_rotation, of_translation = windows.covariance_parts()
    covariance = rotation[:, None, None, None] * of_rotation + translation[:, None, None, None] * of_translation
    covariance[~windows.used] = np.eye(6)
    return covariance


def predicted(state: State) -> Array:
    """The motions (m, n, 4, 4) that the sensors should measure."""
    M = _true_motions(state)
    M[..., :3, 3] *= state.scale[:, None, None]
    return M


def _true_motions(state: State) -> Array:
    """The motions (m, n, 4, 4) in true lengths."""
    return se3.inverse(state.T)[:, None] @ state.motion @ state.T[:, None]


def _back(true: Array) -> Array:
    """Ad(M^-1) (m, n, 6, 6) of true motions."""
    m, n = true.shape[:2]
    return se3.adjoint(se3.inverse(true.reshape(m * n, 4, 4))).reshape(m, n, 6, 6)


def linearised(windows: WindowMotions, state: State) -> Linear:
    """Residuals and derivatives."""
    m, n = windows.used.shape
    M = predicted(state)
    r = se3.logmap((se3.inverse(M) @ windows.M).reshape(m * n, 4, 4)).reshape(m, n, 6)
    r = r + windows.by_offset * state.offset[:, None, None]
    J = np.zeros((m, n, 6, 8))
    J[..., :6] = np.eye(6) - _back(_true_motions(state))
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
    """The covariance (n, 6, 6) of motions estimated with weights W, if the sensors' covariance is V (m, n, 6, 6)."""
    WB = W @ linear.B
    inverse = np.linalg.inv(D)
    covariance: Array = inverse @ np.einsum("mnia,mnij,mnjb->nab", WB, V, WB, optimize=True) @ inverse
    return covariance


def information_of_noise(linear: Linear, W: Array, layout: Layout, state: State, D: Array, of_motion: Array) -> Array:
    """N (p, p): the part of H that comes only from the estimated motions' noise, of covariance ``of_motion``."""
    m, n = W.shape[:2]
    true = _true_motions(state)
    back = _back(true)
    # The columns of a square root of the motions' covariance, in each sensor's frame.
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
    return 0.5 * (N + N.T)


def _by_window(blocks: Array, layout: Layout) -> Array:
    """Blocks (m, n, 6, 8) placed in their sensors' columns, (n, 6, p)."""
    G = np.zeros((blocks.shape[1], 6, layout.size + 1))
    for k in range(len(blocks)):
        G[:, :, layout.at[k]] += blocks[k]
    return G[:, :, :-1]


def _own(blocks: Array, layout: Layout) -> Array:
    """Blocks (m, 8, 8) placed on the diagonal of a matrix (p, p)."""
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
