"""The Fisher information that a part's motions give about poses and scales, and the share that A's noise creates.

Users perturb the parameters. Each free frame has [omega, v], a right perturbation T Expmap(xi) in GTSAM's order (rad,
m); each unknown scale has its logarithm. The information is the *expected* one: it takes B's prediction Y^-1 A X at the
answer, not B's noisy measurement. So only the noise of A can pass for information, and the moments of A suffice. With
c_i = R_A t_X + t_A - t_Y (the true translation that B sees, in the sensor carrier's frame):

- rotation residual, weight 2 kappa:        omega_X - (R_Y' R_A R_X)' omega_Y
- translation residual, weight alpha^2/s^2: R_A R_X v_X - R_Y v_Y + c^ R_Y omega_Y + c dlog alpha
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.problem.moments import ONE, R_A, T_A, T_B
from gtsam_rwhec.solver.parts import Part
from gtsam_rwhec.solver.residuals import PairPoses
from gtsam_rwhec.solver.rotations import HATS

#: The noise counts as at least this, in radians and as a part of the measured lengths. If it were zero, rounding errors
#: of the eigenvalues (1e-16 / floor^2) would look like information.
FLOOR = 1e-7
#: A pair has 15 parameters: seven of the target, seven of the sensor, the logarithm of the shared scale. A frame has
#: seven: rotation, translation, logarithm of its own scale.
OMEGA_X, V_X, OWN_X, OMEGA_Y, V_Y, SHARED = slice(0, 3), slice(3, 6), 6, slice(7, 10), slice(10, 13), 14

_UPPER = np.triu_indices(15, 1)


@dataclass(frozen=True)
class PartVarianceFactors:
    """Variance factors of each pair's residuals, (E,): 1 where the weights are true.

    ``degrees_of_freedom`` is equations minus unknowns of the whole part.
    """

    translation: Array
    rotation: Array
    degrees_of_freedom: int


def variance_factors(part: Part, J_t: Array, J_R: Array) -> PartVarianceFactors:
    """Variance factors from the costs J_t, J_R (E,) of the pairs at the optimum, in the physical model.

    A pair has the variance factor of the part, or its own where that is larger. J_t is sum |r|^2 / (2 sigma^2), and J_R
    is sum kappa |dR|_F^2 / 2 = sum kappa theta^2. Both have expectation 3 N / 2, as rotations have variance 1 / (2
    kappa) an axis. The part's factors are corrected for the unknowns that were fitted.
    """
    counts, N = part.moments.count, part.number_of_measurements
    degrees_of_freedom = 6 * N - part.number_of_unknowns
    if degrees_of_freedom <= 0:  # the noise cannot be estimated: use the weights
        return PartVarianceFactors(np.ones(len(counts)), np.ones(len(counts)), degrees_of_freedom)
    correction = 6.0 * N / degrees_of_freedom
    lengths = np.einsum("eii->e", part.moments.translation[:, T_B, T_B])
    factors = []
    for J, floor in (
        (J_t, (lengths + 1e-4 * part.moments.weight) * FLOOR**2 / counts),  # t_B counts as 1 cm at least
        (J_R, 2.0 * part.moments.kappa * FLOOR**2 / counts),
    ):
        of_part = correction * float(J.sum()) / (1.5 * N)
        factors.append(np.maximum(np.maximum(J / (1.5 * counts), of_part), floor))
    return PartVarianceFactors(factors[0], factors[1], degrees_of_freedom)


@dataclass(frozen=True)
class PairInformation:
    """Of every pair: the information of its rotation and translation residuals, and what noise alone would create.

    rotation, translation (E, 15, 15); noise_rotation, noise_translation (E, 15), diagonal; used (E, 15): whether the
    pair has the parameter; carrier_noise (E,) in rad^2: the largest variance that an axis of A's rotations may have.
    """

    rotation: Array
    translation: Array
    noise_rotation: Array
    noise_translation: Array
    used: np.ndarray
    carrier_noise: Array


def pair_information(part: Part, poses: PairPoses, noise: PartVarianceFactors) -> PairInformation:
    """The information of every pair and its noise, all pairs at once.

    In a direction that the true motions leave free, A's rotation error eps (variance q^2 an axis) turns a zero into
    eps x omega or eps x v, with expected square 2 q^2 |.|^2. Both ends move together along a free direction, so each
    takes half. The residuals do not separate A's noise from B's, but they bound A's noise. The rotation residuals hold
    all of it, so q^2 <= f_R / (2 kappa). The translation residuals hold it on a lever arm a, so 2 q^2 |a|^2 <= 3 f_t
    sigma^2. If A's rotation error is about the origin of its target carrier, the arm is t_X. If it is about the origin
    of its sensor carrier, the arm is c. The shorter arm gives the safe bound. A's translation noise is at most f_t
    sigma^2 an axis: 2 f_t |omega_Y|^2, and 3 f_t for a scale.
    """
    E = len(part.pairs)
    R_X, t_X, R_Y, t_Y, alpha = poses.R_X, poses.t_X, poses.R_Y, poses.t_Y, poses.alpha
    free, owners = frozenset(part.free), frozenset(part.scale_owners)
    G, W = part.moments.translation, part.moments.weight
    K, n = part.moments.kappa, part.moments.count

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

    given_t_X = t_X + np.array([part.frame_shift(target) for target, _ in part.pairs])
    arm = np.minimum((given_t_X**2).sum(axis=1), square / W)
    by_arm = 1.5 * noise.translation * n / np.maximum(alpha**2 * W * arm, 1e-300)
    q2 = np.maximum(np.minimum(noise.rotation * n / (2.0 * K), by_arm), FLOOR**2)
    noise_rotation, noise_translation = np.zeros((E, 15)), np.zeros((E, 15))
    for omega, v in ((OMEGA_X, V_X), (OMEGA_Y, V_Y)):
        noise_rotation[:, omega] = (2.0 * K * q2)[:, None]
        noise_translation[:, omega] = (noise.translation * n)[:, None]
        noise_translation[:, v] = (alpha**2 * W * q2)[:, None]
    noise_translation[:, SHARED] = 3.0 * noise.translation * n

    used = np.zeros((E, 15), dtype=bool)
    for e, pair in enumerate(part.pairs):
        if pair.is_motion:  # both ends are one frame: fold the first onto the second
            for full in (rotation[e], translation[e]):
                full[7:14] += full[:7]
                full[:, 7:14] += full[:, :7]
                full[:7] = full[:, :7] = 0.0
            noise_rotation[e, 7:14] += noise_rotation[e, :7]
            noise_translation[e, 7:14] += noise_translation[e, :7]
            noise_rotation[e, :7] = noise_translation[e, :7] = 0.0
        used[e, :6] = pair.target in free and not pair.is_motion
        used[e, 7:13] = pair.sensor in free
        used[e, SHARED] = part.scale == "shared"
        if pair.target in owners:
            at = 13 if pair.is_motion else OWN_X
            for full in (translation[e], translation[e].T):
                full[at] += full[SHARED]
            translation[e, at, at] = alpha[e] ** 2 * square[e]
            noise_translation[e, at] = noise_translation[e, SHARED]
            used[e, at] = True
    return PairInformation(rotation, translation, noise_rotation, noise_translation, used, q2)


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
