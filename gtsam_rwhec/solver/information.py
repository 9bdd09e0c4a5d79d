"""The Fisher information that a part's motions give about poses and scales.

Users perturb the parameters. Each free frame has [omega, v], a right perturbation T Expmap(xi) in GTSAM's order (rad,
m); each unknown scale has its logarithm. The information is the *expected* one: it takes B's prediction Y^-1 A X at the
answer, not B's noisy measurement. So only A's noise can pass for information (``noise_bounds``), and A's
moments suffice. With
c_i = R_A t_X + t_A - t_Y (the true translation that B sees, in the sensor carrier's frame):

- rotation residual, weight 2 kappa:        omega_X - (R_Y' R_A R_X)' omega_Y
- translation residual, weight alpha^2/s^2: R_A R_X v_X - R_Y v_Y + c^ R_Y omega_Y + c dlog alpha
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
from rwhec_factors.se3 import pose

from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.problem.moments import R_A, T_A
from gtsam_rwhec.solver.answers import PairPoses
from gtsam_rwhec.solver.block_matrix import BlockMatrix, sum_into
from gtsam_rwhec.solver.elimination import Elimination
from gtsam_rwhec.solver.parts import Part
from gtsam_rwhec.solver.rotations import HATS

#: A pair has 15 parameters: seven of the target, seven of the sensor, the logarithm of the shared scale. A frame has
#: seven: rotation, translation, logarithm of its own scale.
OMEGA_X, V_X, OWN_X, OMEGA_Y, V_Y, SHARED = slice(0, 3), slice(3, 6), 6, slice(7, 10), slice(10, 13), 14
#: The information of this many pairs is computed at once: some megabytes.
PAIRS_AT_ONCE = 512

BLOCKS = "frames", "couplings", "tails", "tail"
#: The parameters of the target and of the sensor.
SIDES = slice(0, 7), slice(7, 14)
#: Which of them are rotations.
IS_ROTATION = np.isin(np.arange(15), (0, 1, 2, 7, 8, 9))

_UPPER = np.triu_indices(15, 1)
#: The features of A, among those without R_B.
_OF_A = np.r_[R_A, T_A, 15]
_EYE = np.eye(3)


@dataclass(frozen=True)
class PairInformation:
    """The sums from which each pair's information is computed; the matrices are computed for some pairs at a time."""

    kappa: Array  #: (E,)
    weight: Array  #: (E,)
    alpha: Array  #: (E,), the scale
    R_Y: Array  #: (E, 3, 3)
    turned: Array  #: (E, 3, 3): sum w (R_Y' R_A R_X)'
    arm: Array  #: (E, 3, 3): sum w R_X' R_A' c^ R_Y
    along: Array  #: (E, 3): sum w R_X' R_A' c
    #: (E, 3) and (E, 3, 3): sum w c and sum w c c', in the sensor carrier's frame.
    lever: Array
    lever_squares: Array
    #: (E, 15): whether the pair has the parameter.
    used: np.ndarray
    motion: np.ndarray  #: (E,): whether both ends are one frame
    owns: np.ndarray  #: (E,): whether the target (or the sensor of motions) has a scale of its own
    #: By pair (15, 15): of the rotations and translations of measurements that weigh by direction.
    directed: Mapping[int, tuple[Array, Array]]

    def rotation(self, at: slice | np.ndarray = slice(None)) -> Array:
        """The information of some pairs' rotation residuals, (k, 15, 15)."""
        K = self.kappa[at]
        full = np.zeros((len(K), 15, 15))
        full[:, OMEGA_X, OMEGA_X] = full[:, OMEGA_Y, OMEGA_Y] = 2.0 * K[:, None, None] * _EYE
        full[:, OMEGA_X, OMEGA_Y] = -2.0 * (K / self.weight[at])[:, None, None] * self.turned[at]
        self._put(full, at, 0)
        self._fold(full, at)
        return full

    def _put(self, full: Array, at: slice | np.ndarray, kind: int) -> None:
        """Replace the information of pairs that weigh by direction: of rotations (0) or of translations (1)."""
        if self.directed:
            places = np.arange(len(self.kappa))[at]
            for k in np.flatnonzero(np.isin(places, list(self.directed))):
                full[k] = self.directed[int(places[k])][kind]

    def translation(self, at: slice | np.ndarray = slice(None)) -> Array:
        """The information of some pairs' translation residuals, (k, 15, 15)."""
        R_Y, c, cc = self.R_Y[at], self.lever[at], self.lever_squares[at]
        R_Yt = R_Y.transpose(0, 2, 1)
        full = np.zeros((len(c), 15, 15))
        full[:, V_X, V_X] = full[:, V_Y, V_Y] = self.weight[at][:, None, None] * _EYE
        full[:, V_X, V_Y] = -self.turned[at]
        full[:, V_X, OMEGA_Y] = self.arm[at]
        skew = np.einsum("em,kjm->ekj", c, HATS)  # sum w c^
        full[:, OMEGA_Y, V_Y] = -(R_Yt @ skew @ R_Y).transpose(0, 2, 1)
        square = np.einsum("eii->e", cc)
        full[:, OMEGA_Y, OMEGA_Y] = R_Yt @ (square[:, None, None] * _EYE - cc) @ R_Y
        full[:, V_X, SHARED] = self.along[at]
        full[:, V_Y, SHARED] = -np.einsum("eij,ej->ei", R_Yt, c)
        full[:, SHARED, SHARED] = square  # c^ c = 0: nothing with omega_Y
        full *= (self.alpha[at] ** 2)[:, None, None]
        self._put(full, at, 1)
        self._fold(full, at)
        for owns, place in ((self.owns & ~self.motion, OWN_X), (self.owns & self.motion, 13)):
            rows = np.flatnonzero(owns[at])
            full[rows, place] += full[rows, SHARED]
            full[rows, :, place] += full[rows, :, SHARED]
            full[rows, place, place] = full[rows, SHARED, SHARED]
        return full

    def _fold(self, full: Array, at: slice | np.ndarray) -> None:
        """Fill the lower triangles; of motions, whose ends are one frame, fold the first end onto the second."""
        full[:, _UPPER[1], _UPPER[0]] = full[:, _UPPER[0], _UPPER[1]]
        rows = np.flatnonzero(self.motion[at])
        if len(rows):
            one = full[rows]
            one[:, 7:14] += one[:, :7]
            one[:, :, 7:14] += one[:, :, :7]
            one[:, :7] = one[:, :, :7] = 0.0
            full[rows] = one


def pair_information(part: Part, poses: PairPoses) -> PairInformation:
    """The information of every pair, from the moments of some pairs at a time."""
    E = len(part.pairs)
    moments = part.moments
    turned, arm, along = np.empty((E, 3, 3)), np.empty((E, 3, 3)), np.empty((E, 3))
    lever, lever_squares = np.empty((E, 3)), np.empty((E, 3, 3))
    for at in moments.blocks():
        G = moments.fronts(at)[:, _OF_A[:, None], _OF_A]
        R_Xt, R_Y = poses.R_X[at].transpose(0, 2, 1), poses.R_Y[at]
        k = len(G)
        # Moments of c = R_A t_X + t_A - t_Y, linear in A's features: c = [t_X' (x) I, I, -t_Y] f.
        linear = np.zeros((k, 3, 13))
        linear[:, :, :9] = np.einsum("ej,ik->eijk", poses.t_X[at], _EYE).reshape(k, 3, 9)
        linear[:, :, 9:12] = _EYE
        linear[:, :, 12] = -poses.t_Y[at]
        Gc = G @ linear.transpose(0, 2, 1)  # sum w f c'
        lever_squares[at] = linear @ Gc
        lever[at] = Gc[:, 12]
        Rt = G[:, :9, 12].reshape(k, 3, 3)  # sum w R_A'
        Rt_c = Gc[:, :9].reshape(k, 3, 3, 3)  # [i, k, m]: sum w R_A[k, i] c[m]
        turned[at] = R_Xt @ Rt @ R_Y
        # (c^)_{kj} = -eps_{kjm} c_m, so sum w (R_A' c^)_{ij} = -sum w R_A[k, i] eps_{kjm} c_m.
        arm[at] = R_Xt @ np.einsum("eikm,kjm->eij", Rt_c, HATS) @ R_Y
        along[at] = np.einsum("eij,ej->ei", R_Xt, np.einsum("eikk->ei", Rt_c))
    free, owns, motion = part.ends < len(part.free), part.owns_scale, moments.motion
    used = np.zeros((E, 15), dtype=bool)
    used[:, :6] = (free[:, 0] & ~motion)[:, None]
    used[:, 7:13] = free[:, 1, None]
    target = part.ends[:, 0]
    used[free[:, 0], :6] &= ~part.unseen[target[free[:, 0]]]
    directed = {}
    for each in part.directed:
        e = each.e
        X, Y = pose(poses.R_X[e], poses.t_X[e]), pose(poses.R_Y[e], poses.t_Y[e])
        directed[e] = each.information(*part.centres(e), X, Y, float(poses.alpha[e]))
    used[:, SHARED] = part.scale == "shared"
    used[:, OWN_X], used[:, 13] = owns & ~motion, owns & motion
    sums = turned, arm, along, lever, lever_squares
    return PairInformation(moments.kappa, moments.weight, poses.alpha, poses.R_Y, *sums, used, motion, owns, directed)


def order_of(part: Part) -> Elimination:
    """In which order the frames of a part are eliminated: the couplings are its pairs of two free frames."""
    ends = np.sort(part.ends[_coupled(part)], axis=1)
    return Elimination.of(len(part.free), ends[:, 0], ends[:, 1])


def _coupled(part: Part) -> np.ndarray:
    """(E,): whether a pair has two free frames."""
    return (part.ends < len(part.free)).all(axis=1) & ~part.moments.motion


def information(
    part: Part, order: Elimination, of_pairs: Callable[[slice], Array], priors: Array | None = None
) -> BlockMatrix:
    """The information of all frames, seven parameters each, and of the logarithm of the shared scale, the tail.

    ``of_pairs`` returns the information of some pairs (k, 15, 15), as `PairInformation` does; ``priors`` (n, 7) is a
    diagonal.
    """
    n, E = len(part.free), len(part.pairs)
    coupled = _coupled(part)
    place = np.cumsum(coupled) - 1
    frames, tails, tail = np.zeros((n, 7, 7)), np.zeros((n, 7, 1)), np.zeros((1, 1))
    couplings = np.zeros((int(coupled.sum()), 7, 7))
    for begin in range(0, E, PAIRS_AT_ONCE):
        at = slice(begin, begin + PAIRS_AT_ONCE)
        of_each, ends = of_pairs(at), part.ends[at]
        for index, own in zip(ends.T, SIDES, strict=True):
            has = index < n
            sum_into(frames, index[has], of_each[has, own, own])
            sum_into(tails, index[has], of_each[has, own, 14:])
        tail += of_each[:, 14, 14].sum()
        both = coupled[at]
        blocks = of_each[both, :7, 7:14]
        swapped = ends[both, 0] > ends[both, 1]
        blocks[swapped] = blocks[swapped].transpose(0, 2, 1)
        couplings[place[at][both]] = blocks
    if priors is not None:
        np.einsum("nii->ni", frames)[...] += priors
    return BlockMatrix(order, frames, couplings, tails, tail)


def by_parameters(part: Part, of_pairs: Array) -> Array:
    """Sum numbers of the pairs' parameters (E, 15) over the pairs: (7 n + 1,)."""
    n = len(part.free)
    frames = np.zeros((n + len(part.fixed), 7))
    for index, own in zip(part.ends.T, SIDES, strict=True):
        np.add.at(frames, index, of_pairs[:, own])
    return np.append(frames[:n], of_pairs[:, 14].sum())


def prior_information(part: Part) -> tuple[Array, Array]:
    """The diagonal of the priors' information about rotations (n, 7), and about translations (n, 7)."""
    rotation, translation = np.zeros((len(part.free), 7)), np.zeros((len(part.free), 7))
    for i, name in enumerate(part.free):
        for prior in part.priors.get(name, []):
            if prior.kappa is not None:
                rotation[i, :3] += 2.0 * prior.kappa
            if prior.sigma is not None:
                translation[i, 3:6] += 1.0 / prior.sigma**2
    return rotation, translation


@dataclass(frozen=True)
class PartInformation:
    """The information of rotation residuals and of translation residuals, and which parameters exist (7 n + 1,)."""

    rotation: BlockMatrix
    translation: BlockMatrix
    used: np.ndarray

    @staticmethod
    def of(part: Part, pairs: PairInformation, order: Elimination | None = None) -> PartInformation:
        """The sums over a part's pairs, and the priors."""
        of_rotations, of_translations = prior_information(part)
        order = order or order_of(part)
        return PartInformation(
            information(part, order, pairs.rotation, of_rotations),
            information(part, order, pairs.translation, of_translations),
            by_parameters(part, pairs.used.astype(float)) > 0.0,
        )

    @property
    def is_rotation(self) -> np.ndarray:
        """(7 n + 1,): which parameters are rotations."""
        return np.append(np.tile(np.arange(7) < 3, len(self.used) // 7), False)

    @property
    def together(self) -> BlockMatrix:
        """The information of all residuals."""
        sums = (getattr(self.rotation, name) + getattr(self.translation, name) for name in BLOCKS)
        return BlockMatrix(self.rotation.order, *sums)
