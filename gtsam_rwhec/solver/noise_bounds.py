"""The rule that decides whether a direction is free."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import chdtri, fdtri

from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.problem.moments import ONE, R_A, T_B
from gtsam_rwhec.solver.answers import PairPoses
from gtsam_rwhec.solver.information import OMEGA_X, OMEGA_Y, OWN_X, SHARED, V_X, V_Y, PairInformation, PartInformation
from gtsam_rwhec.solver.parts import Part

#: The probability that a free direction counts as determined.
SIGNIFICANCE = 1e-3
#: Redundant equations (``spare``) count as at least this many: the quantile is 1e60 here, and would overflow below.
LEAST_SPARE = 0.1


def free_threshold(squares: Array | float, fitted: Array | float, spare: Array | float) -> Array:
    """A direction with no more information is free. The unit is the information that noise alone would create in it.

    Noise alone gives a sum of ``squares`` squares. The direction is the weakest, so its fit removes ``fitted`` of them;
    at least one is left. With ``spare`` redundant equations, which estimate the noise, the threshold is an F quantile
    times the share of the squares that is left. With none, the weights give the noise, and the threshold is the
    chi-square quantile over ``squares``.
    """
    left = np.maximum(np.subtract(squares, fitted), 1.0)
    quantile = fdtri(left, np.maximum(spare, LEAST_SPARE), 1.0 - SIGNIFICANCE)
    if np.min(spare, initial=1.0) <= 0.0:
        quantile = np.where(np.greater(spare, 0.0), quantile, chdtri(left, SIGNIFICANCE) / left)
    return np.asarray(quantile * left / squares)


#: The noise counts as at least this, in radians and as a part of the measured lengths. If it were zero, rounding errors
#: of the eigenvalues (1e-16 / floor^2) would look like information.
FLOOR = 1e-7
#: With this many redundant equations in the worst case, it does not matter which equations the fit used: the threshold
#: changes by a few per cent.
PLENTY = 100
#: Above this many parameters the worst case counts, and no dense matrix is made.
DENSE_PARAMETERS = 400
#: Information below this part of the largest is rounding error.
ROUNDING = 1e-12


@dataclass(frozen=True)
class PartVarianceFactors:
    """Variance factors of each pair's residuals, (E,): 1 where the weights are true.

    The numbers of redundant equations (``spare``) say how well the residuals determine them; all are 0 where only the
    weights do.
    """

    rotation: Array
    #: At given rotations: for the parameters that are tested after all rotations are determined.
    translation: Array
    #: With rotations fitted to the translations too: for the bound on A's rotation noise.
    on_arm: Array
    spare_rotation: float
    spare_translation: float
    spare_on_arm: float


def variance_factors(part: Part, told: PartInformation, J_t: Array, J_R: Array) -> PartVarianceFactors:
    """Variance factors from the costs J_t, J_R (E,) of the pairs at the optimum, in the physical model.

    A pair has the variance factor of the part, or its own where that is larger. J_t is sum |r|^2 / (2 sigma^2), and J_R
    is sum kappa |dR|_F^2 / 2 = sum kappa theta^2. Both have as expectation half the equations (3 N of poses), as
    rotations have variance 1 / (2 kappa) an axis. The part's factors are corrected for the unknowns that were fitted.
    """
    counts, N = part.moments.count, part.equations.sum(axis=0)
    if part.number_of_unknowns >= N.sum():  # the noise cannot be estimated: use the weights
        ones = np.ones(len(counts))
        return PartVarianceFactors(ones, ones, ones, 0.0, 0.0, 0.0)
    spare_on_arm, spare_rotation = equations_to_spare(part, told)
    spare_translation = float(max(N[1] - part.number_of_unknowns + _turns(part), 0.0))
    lengths = part.moments.squares(T_B)
    floor_t = (lengths + 1e-4 * part.moments.weight) * FLOOR**2 / counts  # t_B counts as 1 cm at least
    floor_R = 2.0 * part.moments.kappa * FLOOR**2 / counts

    def factors(J: Array, spare: float, floor: Array, equations: Array) -> Array:
        of_part = 2.0 * float(J.sum()) / max(spare, 1.0)
        return np.maximum(np.maximum(J / (0.5 * np.maximum(equations, 1.0)), of_part), floor)

    return PartVarianceFactors(
        factors(J_R, spare_rotation, floor_R, part.equations[:, 0]),
        factors(J_t, spare_translation, floor_t, part.equations[:, 1]),
        factors(J_t, spare_on_arm, floor_t, part.equations[:, 1]),
        spare_rotation,
        spare_translation,
        spare_on_arm,
    )


def equations_to_spare(part: Part, told: PartInformation) -> tuple[float, float]:
    """The numbers of redundant equations of translations and of rotations after the fit.

    In the worst case all unknowns were fitted to the translations, and all rotations to the rotations.
    """
    of_rotations, of_translations = part.equations.sum(axis=0).tolist()
    worst = max(of_translations - part.number_of_unknowns, 0.0), max(of_rotations - _turns(part), 0.0)
    used = told.used
    if worst[0] >= PLENTY or used.sum() > DENSE_PARAMETERS:
        return worst
    I_R, I_t = (each.dense()[used][:, used] for each in (told.rotation, told.translation))
    unit = 1.0 / np.sqrt(np.maximum(np.diagonal(I_R) + np.diagonal(I_t), 1e-300))
    I_R, I_t = I_R * unit[:, None] * unit, I_t * unit[:, None] * unit
    if not np.isfinite(I_R + I_t).all():  # lengths or scales whose squares overflow
        return worst
    values, vectors = np.linalg.eigh(I_R + I_t)
    known = values > ROUNDING * values.max(initial=0.0)
    root = vectors[:, known] / np.sqrt(values[known])
    by_translations, by_rotations = (float((root * (info @ root)).sum()) for info in (I_t, I_R))
    return max(of_translations - by_translations, 0.0), max(of_rotations - by_rotations, 0.0)


def _turns(part: Part) -> int:
    """The number of unknowns of rotations."""
    return 3 * len(part.free) - int(part.unseen[:, :3].sum())


@dataclass(frozen=True)
class PairNoise:
    """The information that noise alone would create in every pair: a diagonal (E, 15) for each kind of residual."""

    rotation: Array
    translation: Array
    #: (E,), rad^2: the largest variance that an axis of A's rotations may have.
    carrier: Array
    #: (E,): the redundant equations from which it is estimated.
    spare: Array
    #: The redundant equations from which the noise of translations is estimated.
    spare_translation: float
    #: Whether redundant equations are few. Only then are the squares that the fit removes counted; else the safe bound
    #: costs little.
    few: bool


def pair_noise(
    part: Part, poses: PairPoses, pairs: PairInformation, noise: PartVarianceFactors, in_target: Array, in_sensor: Array
) -> PairNoise:
    """What noise alone would create, all pairs at once; ``in_target`` and ``in_sensor`` are ``common_axes``.

    In a direction that the true motions leave free, A's rotation error eps (variance q^2 an axis) turns a zero into
    eps x omega or eps x v, with expected square 2 q^2 |.|^2. Both ends move together along a free direction, so each
    takes half. The residuals do not separate A's noise from B's, but they bound A's noise. The rotation residuals hold
    all of it, so q^2 <= f_R / (2 kappa). The translation residuals hold it on a lever arm a, so 2 q^2 |a|^2 <= 3 f_t
    sigma^2 (``_lever_arms``). A's translation noise is at most f_t sigma^2 an axis: 2 f_t |omega_Y|^2, and 3 f_t for a
    scale.
    """
    E, alpha = len(part.pairs), poses.alpha
    W, K, n = part.moments.weight, part.moments.kappa, part.moments.count
    few = noise.spare_on_arm < PLENTY
    arms = _lever_arms(part, poses, pairs, (in_target, in_sensor) if few else None)
    by_arm = 1.5 * noise.on_arm * n / np.maximum(alpha**2 * W * arms, 1e-300)
    by_rotations = noise.rotation * n / (2.0 * K)
    if noise.spare_rotation > 0.0 and noise.spare_on_arm < 1.0:
        by_arm[:] = np.inf
    of_arms = 2.0 / 3.0 * noise.spare_on_arm  # along the arm A's rotation error shows nothing
    arm_counts = by_arm < by_rotations
    if few:
        spares, fitted = (noise.spare_rotation, of_arms), fitted_squares(part)
        of_rotations, of_arm = (free_threshold(2.0 * n, fitted, spare) for spare in spares)
        arm_counts = by_arm * of_arm < by_rotations * of_rotations
    q2 = np.maximum(np.where(arm_counts, by_arm, by_rotations), FLOOR**2)
    rotation, translation = np.zeros((E, 15)), np.zeros((E, 15))
    for omega, v in ((OMEGA_X, V_X), (OMEGA_Y, V_Y)):
        rotation[:, omega] = (2.0 * K * q2)[:, None]
        translation[:, omega] = (noise.translation * n)[:, None]
        translation[:, v] = (alpha**2 * W * q2)[:, None]
    translation[:, SHARED] = 3.0 * noise.translation * n
    for full in (rotation, translation):  # both ends of a motion are one frame
        full[pairs.motion, 7:14] += full[pairs.motion, :7]
        full[pairs.motion, :7] = 0.0
    for owns, place in ((pairs.owns & ~pairs.motion, OWN_X), (pairs.owns & pairs.motion, 13)):
        translation[owns, place] = translation[owns, SHARED]
    spare = np.where(arm_counts, of_arms, noise.spare_rotation)
    return PairNoise(rotation, translation, q2, spare, noise.spare_translation, few)


def fitted_squares(part: Part) -> Array:
    """How many of the 2 n squares of noise along a free direction each pair (E,) loses as the direction is fitted.

    A direction may tilt at each free end, about two axes.
    """
    free = part.ends < len(part.free)
    return 2.0 * np.where(part.moments.motion, free[:, 0], free.sum(axis=1))


def common_axes(part: Part) -> tuple[Array, Array, Array]:
    """The axis that each pair's R_A keep best: in the target carrier (E, 3), in the sensor carrier (E, 3).

    Also the singular values (E, 3) of the mean of R_A, descending; 1 where all of them keep the axis.
    """
    transposed = part.moments.entries(R_A, np.array([ONE])).reshape(-1, 3, 3) / part.moments.weight[:, None, None]
    U, s, Vt = np.linalg.svd(transposed)
    return U[:, :, 0], Vt[:, 0], s


def _lever_arms(part: Part, poses: PairPoses, pairs: PairInformation, across: tuple[Array, Array] | None) -> Array:
    """The mean square of the shortest arm (E,), m^2, on which A's rotation error may show in the translations.

    The arm is t_X if the error is about the origin of its target carrier, R_A t_X + t_A if about the origin of its
    sensor carrier, and c if about the sensor. The shortest one gives the safe bound: the whole arm, or its part
    ``across`` the common axes in the target and in the sensor carrier.
    """
    of_frames = np.array([part.frame_shift(name) for name in (*part.free, *part.fixed)])
    shift_X, shift_Y = of_frames[part.ends[:, 0]], of_frames[part.ends[:, 1]]
    t_X, t_Y, W = poses.t_X + shift_X, poses.t_Y + shift_Y, part.moments.weight[:, None, None]
    of_c = pairs.lever_squares / W
    mean_t = np.einsum("ei,ej->eij", pairs.lever, t_Y) / W
    # R_A t_X + t_A = c + t_Y
    at_sensor_carrier = of_c + mean_t + mean_t.transpose(0, 2, 1) + np.einsum("ei,ej->eij", t_Y, t_Y)
    at_target_carrier = np.einsum("ei,ej->eij", t_X, t_X)
    arms = np.array([np.einsum("eii->e", square) for square in (at_target_carrier, at_sensor_carrier, of_c)])
    if across is not None:
        axes = across[0], across[1], across[1]
        for arm, square, axis in zip(arms, (at_target_carrier, at_sensor_carrier, of_c), axes, strict=True):
            arm -= np.einsum("ei,eij,ej->e", axis, square, axis)
    shortest: Array = np.maximum(arms.min(axis=0), 0.0)
    return shortest
