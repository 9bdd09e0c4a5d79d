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

from dataclasses import dataclass

import numpy as np

from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.problem.moments import ONE, R_A, T_A
from gtsam_rwhec.solver.parts import Part
from gtsam_rwhec.solver.residuals import PairPoses
from gtsam_rwhec.solver.rotations import HATS

#: A pair has 15 parameters: seven of the target, seven of the sensor, the logarithm of the shared scale. A frame has
#: seven: rotation, translation, logarithm of its own scale.
OMEGA_X, V_X, OWN_X, OMEGA_Y, V_Y, SHARED = slice(0, 3), slice(3, 6), 6, slice(7, 10), slice(10, 13), 14

_UPPER = np.triu_indices(15, 1)


@dataclass(frozen=True)
class PairInformation:
    """Of every pair: the information of its rotation and translation residuals (E, 15, 15)."""

    rotation: Array
    translation: Array
    #: (E, 15): whether the pair has the parameter.
    used: np.ndarray
    #: (E, 3) and (E, 3, 3): sum w c and sum w c c', in the sensor carrier's frame.
    lever: Array
    lever_squares: Array


def pair_information(part: Part, poses: PairPoses) -> PairInformation:
    """The information of every pair, all pairs at once."""
    E = len(part.pairs)
    R_X, t_X, R_Y, t_Y, alpha = poses.R_X, poses.t_X, poses.R_Y, poses.t_Y, poses.alpha
    free, owners = frozenset(part.free), frozenset(part.scale_owners)
    G, W = np.nan_to_num(part.moments.translation[:]), part.moments.weight
    K = part.moments.kappa

    # Moments of c = R_A t_X + t_A - t_Y, linear in A's features: c = [t_X' (x) I, I, -t_Y] f.
    linear = np.zeros((E, 3, 25))
    linear[:, :, R_A] = np.einsum("ej,ik->eijk", t_X, np.eye(3)).reshape(E, 3, 9)
    linear[:, :, T_A] = np.eye(3)
    linear[:, :, ONE] = -t_Y
    Gc = G @ linear.transpose(0, 2, 1)  # sum w f c'
    cc = linear @ Gc
    c = Gc[:, ONE]
    Rt = G[:, R_A, ONE].reshape(E, 3, 3)  # sum w R_A'
    Rt_c = Gc[:, R_A].reshape(E, 3, 3, 3)  # [i, k, m]: sum w R_A[k, i] c[m]

    R_Xt, R_Yt = R_X.transpose(0, 2, 1), R_Y.transpose(0, 2, 1)
    turned = R_Xt @ Rt @ R_Y  # sum w (R_Y' R_A R_X)'
    eye = np.eye(3)
    rotation = np.zeros((E, 15, 15))
    rotation[:, OMEGA_X, OMEGA_X] = rotation[:, OMEGA_Y, OMEGA_Y] = 2.0 * K[:, None, None] * eye
    rotation[:, OMEGA_X, OMEGA_Y] = -2.0 * (K / W)[:, None, None] * turned
    translation = np.zeros((E, 15, 15))
    translation[:, V_X, V_X] = translation[:, V_Y, V_Y] = W[:, None, None] * eye
    translation[:, V_X, V_Y] = -turned
    # (c^)_{kj} = -eps_{kjm} c_m, so sum w (R_A' c^)_{ij} = -sum w R_A[k, i] eps_{kjm} c_m.
    Rt_skew = np.einsum("eikm,kjm->eij", Rt_c, HATS)
    translation[:, V_X, OMEGA_Y] = R_Xt @ Rt_skew @ R_Y
    skew = np.einsum("em,kjm->ekj", c, HATS)  # sum w c^
    translation[:, OMEGA_Y, V_Y] = -(R_Yt @ skew @ R_Y).transpose(0, 2, 1)
    square = np.einsum("eii->e", cc)
    translation[:, OMEGA_Y, OMEGA_Y] = R_Yt @ (square[:, None, None] * eye - cc) @ R_Y
    translation[:, V_X, SHARED] = np.einsum("eij,ej->ei", R_Xt, np.einsum("eikk->ei", Rt_c))
    translation[:, V_Y, SHARED] = -np.einsum("eij,ej->ei", R_Yt, c)
    translation[:, SHARED, SHARED] = square  # c^ c = 0: nothing with omega_Y
    for full in (rotation, translation):
        full[:, _UPPER[1], _UPPER[0]] = full[:, _UPPER[0], _UPPER[1]]
    translation *= (alpha**2)[:, None, None]

    used = np.zeros((E, 15), dtype=bool)
    for e, pair in enumerate(part.pairs):
        if pair.is_motion:  # both ends are one frame: fold the first onto the second
            for full in (rotation[e], translation[e]):
                full[7:14] += full[:7]
                full[:, 7:14] += full[:, :7]
                full[:7] = full[:, :7] = 0.0
        used[e, :6] = pair.target in free and not pair.is_motion
        used[e, 7:13] = pair.sensor in free
        used[e, SHARED] = part.scale == "shared"
        if pair.target in owners:
            at = 13 if pair.is_motion else OWN_X
            for full in (translation[e], translation[e].T):
                full[at] += full[SHARED]
            translation[e, at, at] = alpha[e] ** 2 * square[e]
            used[e, at] = True
    return PairInformation(rotation, translation, used, c, cc)


@dataclass(frozen=True)
class Information:
    """Arrow matrix: leaf (L, 7, 7), coupling (L, 7, 7 P + 1), border (7 P + 1 square); and the diagonal of the noise.

    The border has seven parameters of each center, then the logarithm of the shared scale. ``noise`` and ``used`` have
    one entry for each parameter, (7 L + 7 P + 1,).
    """

    leaf: Array
    coupling: Array
    border: Array
    noise: Array
    used: np.ndarray


def information(part: Part, by_pair: Array, noise: Array, used: np.ndarray, priors: Array) -> Information:
    """Add up pairs' information (E, 15, 15) and noise (E, 15), and the priors' (n, 7) diagonal, along the graph."""
    L, P = len(part.leaves), len(part.centers)
    n = L + P
    place = {name: i for i, name in enumerate(part.free)}
    ends = np.array([[place.get(name, n) for name in pair] for pair in part.pairs])  # n: a fixed frame
    # Each frame has a row; one row more takes what the fixed frames would get.
    own, with_scale = np.zeros((n + 1, 7, 7)), np.zeros((n + 1, 7))
    frame_noise, frame_used = np.zeros((n + 1, 7)), np.zeros((n + 1, 7), dtype=bool)
    sides = slice(0, 7), slice(7, 14)
    for frames, at in zip(ends.T, sides, strict=True):
        np.add.at(own, frames, by_pair[:, at, at])
        np.add.at(with_scale, frames, by_pair[:, at, 14])
        np.add.at(frame_noise, frames, noise[:, at])
        np.logical_or.at(frame_used, frames, used[:, at])
    coupling, border = np.zeros((L, 7, 7 * P + 1)), np.zeros((7 * P + 1, 7 * P + 1))
    for e in np.flatnonzero((ends < n).all(axis=1) & (ends[:, 0] != ends[:, 1])):
        (i, at_i), (j, at_j) = sorted(zip(ends[e], sides, strict=True))  # the leaf before the center
        coupling[i, :, 7 * (j - L) : 7 * (j - L) + 7] += by_pair[e, at_i, at_j]
    coupling[:, :, -1] = with_scale[:L]
    np.einsum("papb->pab", border[:-1, :-1].reshape(P, 7, P, 7))[...] = own[L:n]
    border[-1, :-1] = border[:-1, -1] = with_scale[L:n].ravel()
    border[-1, -1] = by_pair[:, 14, 14].sum()
    np.einsum("lii->li", own)[:L] += priors[:L]
    np.einsum("ii->i", border)[:-1] += priors[L:].ravel()
    all_noise = np.r_[frame_noise[:n].ravel(), noise[:, 14].sum()]
    return Information(own[:L], coupling, border, all_noise, np.r_[frame_used[:n].ravel(), used[:, 14].any()])


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
