"""What is known beforehand of a frame or a scale: whole poses, parts of them, and the DQ paper's regulariser.

A motion about one axis (a 4-axis robot, a car), or without turning (a Cartesian robot), leaves directions of the
extrinsics free; a known height, tilt or rotation fixes them. ``T`` below is the pose variable, T_carrier_frame =
(R, t): X or Y.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Literal, get_args

import gtsam
import numpy as np
from numpy.typing import ArrayLike

from rwhec_factors import noise_models
from rwhec_factors.measurement import Residual, check_pose
from rwhec_factors.se3 import Array, hat
from rwhec_factors.values import name_of, number_of, pose_of

RotationPenalty = Literal["distance", "imaginary"]

WHAT = "an extrinsic T_carrier_frame"
#: -hat(e_1), -hat(e_2), -hat(e_3): (hat(omega) e_i = -hat(e_i) omega).
_COLUMNS = -hat(np.eye(3))


def pose_prior_factor(
    key: int, T: gtsam.Pose3, noise: gtsam.noiseModel.Base, *, residual: Residual = "geodesic"
) -> gtsam.CustomFactor:
    """A known pose: Log(T_0^-1 T) (6,), or [vec(R - R_0), t - t_0] (12,) as the certified cost has it.

    Parameters
    ----------
    key : int
        Of T, a Pose3.
    T : gtsam.Pose3
        T_0, metres.
    noise : gtsam.noiseModel.Base
        Dimension 6, rotation (rad) first. Geodesic: of T_0's right perturbation, in the frame's own axes. Chordal: one
        sigma for rotation (kappa = 1 / (2 sigma^2)) and one for translation.
    residual : "geodesic" or "chordal"

    Raises
    ------
    TypeError, ValueError
        For what is no pose or no noise model, or noise that cannot be honoured.
    """
    check_pose(T, "the prior's pose")
    _check_residual(residual)
    model = noise_models.checked(noise, 6, "the prior's pose")
    T_0_inverse, R_0, t_0 = T.inverse(), T.rotation().matrix(), T.translation()

    def geodesic(pose: gtsam.Pose3) -> tuple[Array, Array]:
        value = gtsam.Pose3.Logmap(T_0_inverse.compose(pose))
        return value, gtsam.Pose3.LogmapDerivative(value)

    def chordal(pose: gtsam.Pose3) -> tuple[Array, Array]:
        R = pose.rotation().matrix()
        jacobian = np.zeros((12, 6))
        jacobian[:9, :3], jacobian[9:, 3:] = _vec_by_turning(R), R
        return np.concatenate([(R - R_0).ravel(order="F"), pose.translation() - t_0]), jacobian

    if residual == "chordal":
        return _prior(key, noise_models.chordal(model, "the prior's pose"), chordal)
    return _prior(key, model, geodesic)


def rotation_prior_factor(
    key: int, R: gtsam.Rot3, noise: gtsam.noiseModel.Base, *, residual: Residual = "geodesic"
) -> gtsam.CustomFactor:
    """A known rotation, nothing said of the position: Log(R_0' R) (3,) rad, or vec(R - R_0) (9,).

    What a Cartesian robot needs, whose motion alone says nothing of rotations about the direction of travel.

    Parameters
    ----------
    key : int
        Of T, a Pose3.
    R : gtsam.Rot3
        R_0 = R_carrier_frame.
    noise : gtsam.noiseModel.Base
        Dimension 3, rad, in the frame's own axes; for the chordal residual isotropic (kappa = 1 / (2 sigma^2)).
    residual : "geodesic" or "chordal"

    Raises
    ------
    TypeError, ValueError
        For what is no rotation or no noise model, or noise that cannot be honoured.
    """
    if not isinstance(R, gtsam.Rot3):
        raise TypeError(f"the prior's rotation is a {type(R).__name__}; give a gtsam.Rot3 (T.rotation() of a Pose3)")
    _check_residual(residual)
    model = noise_models.checked(noise, 3, "the prior's rotation")
    R_0 = R.matrix()

    def geodesic(pose: gtsam.Pose3) -> tuple[Array, Array]:
        value = gtsam.Rot3.Logmap(R.between(pose.rotation()))
        return value, np.hstack([gtsam.Rot3.LogmapDerivative(value), np.zeros((3, 3))])

    def chordal(pose: gtsam.Pose3) -> tuple[Array, Array]:
        turned = pose.rotation().matrix()
        return (turned - R_0).ravel(order="F"), np.hstack([_vec_by_turning(turned), np.zeros((9, 3))])

    if residual == "chordal":
        return _prior(key, _chordal_rotation(model), chordal)
    return _prior(key, model, geodesic)


def position_prior_factor(key: int, t_m: ArrayLike, noise: gtsam.noiseModel.Base) -> gtsam.CustomFactor:
    """A known position, nothing said of the rotation: t - t_0 (3,), metres.

    Parameters
    ----------
    key : int
        Of T, a Pose3.
    t_m : (3,) array_like
        t_0, in the carrier's frame.
    noise : gtsam.noiseModel.Base
        Dimension 3, metres, along the carrier's axes. For one coordinate or two, `position_along_prior_factor`.

    Raises
    ------
    TypeError, ValueError
        For what is no position or no noise model, or noise that cannot be honoured.
    """
    t_0 = _vector(t_m, "the prior's position t_m")
    model = noise_models.checked(noise, 3, "the prior's position")

    def error(pose: gtsam.Pose3) -> tuple[Array, Array]:
        return pose.translation() - t_0, np.hstack([np.zeros((3, 3)), pose.rotation().matrix()])

    return _prior(key, model, error)


def position_along_prior_factor(key: int, axis: ArrayLike, value_m: float, sigma_m: float) -> gtsam.CustomFactor:
    """A known height, or any one coordinate: axis' t - value (1,), metres.

    Parameters
    ----------
    key : int
        Of T, a Pose3.
    axis : (3,) array_like
        In the carrier's frame; made a unit vector. [0, 0, 1] makes it a height.
    value_m, sigma_m : float
        The position along it, and its standard deviation.

    Raises
    ------
    ValueError
        For an axis without direction, or numbers that are none.
    """
    direction = _direction(axis, "axis")
    value_m = _finite(value_m, "value_m")
    model = gtsam.noiseModel.Isotropic.Sigma(1, _positive(sigma_m, "sigma_m"))

    def error(pose: gtsam.Pose3) -> tuple[Array, Array]:
        along = direction @ pose.rotation().matrix()
        return np.array([direction @ pose.translation() - value_m]), np.concatenate([np.zeros(3), along])[None]

    return _prior(key, model, error)


def direction_prior_factor(
    key: int, axis_frame: ArrayLike, axis_carrier: ArrayLike, sigma_rad: float
) -> gtsam.CustomFactor:
    """A known tilt: R axis_frame points along axis_carrier, turning about it is left free. (2,), rad.

    ::

        e = theta / sin(theta) N' R' axis_carrier       N (3, 2): across axis_frame;  |e| = theta, the angle between

    Parameters
    ----------
    key : int
        Of T, a Pose3.
    axis_frame, axis_carrier : (3,) array_like
        The same direction in the frame's axes and in the carrier's; made unit vectors. A level camera, z ahead and y
        down, has axis_frame [0, 1, 0] and, on a carrier with z up, axis_carrier [0, 0, -1].
    sigma_rad : float
        Standard deviation of each of the two tilts.

    Raises
    ------
    ValueError
        For axes without direction, or a sigma that is not positive.
    """
    frame, carrier = _direction(axis_frame, "axis_frame"), _direction(axis_carrier, "axis_carrier")
    model = gtsam.noiseModel.Isotropic.Sigma(2, _positive(sigma_rad, "sigma_rad"))
    across = np.linalg.svd(frame[None])[2][1:]  # N', (2, 3)

    def error(pose: gtsam.Pose3) -> tuple[Array, Array]:
        d = carrier @ pose.rotation().matrix()  # axis_carrier as the frame has it
        by_turning = hat(d)  # (R Expmap(w))' a = d - w x d = d + hat(d) w
        lateral, along = across @ d, frame @ d
        lateral_by, along_by = across @ by_turning, frame @ by_turning
        sine = float(np.linalg.norm(lateral))
        theta = np.arctan2(sine, along)
        jacobian = np.zeros((2, 6))
        if sine < 1e-8 and along > 0.0:
            jacobian[:, :3] = lateral_by
            return lateral, jacobian
        # Exactly opposite any way round is as short: one is taken, so that an optimiser leaves.
        unit = lateral / sine if sine > 1e-8 else np.array([1.0, 0.0])
        radial = along * (unit @ lateral_by) - sine * along_by  # d theta
        sideways = np.eye(2) - np.outer(unit, unit)
        jacobian[:, :3] = np.outer(unit, radial) + (theta / sine if sine > 1e-8 else 0.0) * sideways @ lateral_by
        return theta * unit, jacobian

    return _prior(key, model, error)


def dual_quaternion_prior_factor(
    key: int, T: gtsam.Pose3, a: float, b: float, *, rotation: RotationPenalty = "distance"
) -> gtsam.CustomFactor:
    """The DQ paper's prior (Section 3.3): Q = Q_0 (x) dQ with dQ = dq + epsilon dq' kept near 1.

    The factor's error (half the squared residual) is what the paper adds to its cost::

        a |1 - dq|^2 + b |dq'|^2        rotation="distance", eq. 25; of +-dQ the one whose scalar part is >= 0
        a dq^T G dq  + b |dq'|^2        rotation="imaginary", eq. 26; G keeps the imaginary parts

    For a deviation by an angle theta and a length d,
    |1 - dq| = 2 sin(theta / 4), the imaginary part is sin(theta / 2) and |dq'| = d / 2: near the prior, a and b are
    sigmas of sqrt(2 / a) rad and sqrt(2 / b) m. Far away "imaginary" pulls less and less, at half a turn not at all;
    "distance" always does.

    Parameters
    ----------
    key : int
        Of T, a Pose3.
    T : gtsam.Pose3
        Q_0 as a pose, metres.
    a, b : float
        Weights, positive.
    rotation : "distance" or "imaginary"

    Raises
    ------
    TypeError, ValueError
        For what is no pose, or weights that are not positive.
    """
    check_pose(T, "the prior's pose")
    if rotation not in get_args(RotationPenalty):
        raise ValueError(f"rotation={rotation!r} is not 'distance' (eq. 25) or 'imaginary' (eq. 26)")
    root_a, root_b = np.sqrt(2.0 * _positive(a, "a")), np.sqrt(2.0 * _positive(b, "b"))
    T_0_inverse = T.inverse()
    kept = slice(0 if rotation == "distance" else 1, None)
    one = np.array([1.0, 0.0, 0.0, 0.0])

    def error(pose: gtsam.Pose3) -> tuple[Array, Array]:
        deviation = T_0_inverse.compose(pose)
        dq = _quaternion_wxyz(deviation.rotation())
        dq_dual = 0.5 * _left(np.concatenate([[0.0], deviation.translation()])) @ dq  # q' = t q / 2
        # dQ (x) (1 + omega / 2 + epsilon v / 2)
        by_dq = np.hstack([0.5 * _left(dq)[:, 1:], np.zeros((4, 3))])
        by_dual = 0.5 * np.hstack([_left(dq_dual)[:, 1:], _left(dq)[:, 1:]])
        value = np.concatenate([root_a * (dq - one)[kept], root_b * dq_dual])
        return value, np.vstack([root_a * by_dq[kept], root_b * by_dual])

    return _prior(key, gtsam.noiseModel.Unit.Create(8 if rotation == "distance" else 7), error)


def log_scale_prior_factor(scale_key: int, scale: float, sigma_log: float) -> gtsam.CustomFactor:
    """A scale known to some per cent: ln(s / s_0) (1,).

    "The tag is 0.160 m +- 1%": with the measurements made for 0.160 m, ``log_scale_prior_factor(key, 1.0, 0.01)``.

    Parameters
    ----------
    scale_key : int
        Of s, a 1-vector: t_B = s * (true length).
    scale, sigma_log : float
        s_0 and the standard deviation of the logarithm, both positive.

    Raises
    ------
    ValueError
        For numbers that are not positive; while optimising, for s <= 0, which has no logarithm.
    """
    log_0 = np.log(_positive(scale, "scale"))
    model = gtsam.noiseModel.Isotropic.Sigma(1, _positive(sigma_log, "sigma_log"))

    def error(factor: gtsam.CustomFactor, values: gtsam.Values, jacobians: list[Any] | None) -> Array:
        s = number_of(values, scale_key, "the scale (measured / true length)")
        if not s > 0.0:
            raise ValueError(
                f"the scale {name_of(scale_key)} is {s}; it must be positive: start nearer to the answer, or where the "
                "handedness is right (a mirror image of the measurements has a negative scale)"
            )
        if jacobians is not None:
            jacobians[0] = np.array([[1.0 / s]])
        return np.array([np.log(s) - log_0])

    return gtsam.CustomFactor(model, [scale_key], error)


def _prior(
    key: int, noise: gtsam.noiseModel.Base, residual: Callable[[gtsam.Pose3], tuple[Array, Array]]
) -> gtsam.CustomFactor:
    """A factor on one pose, from its residual (m,) and Jacobian (m, 6)."""

    def error(factor: gtsam.CustomFactor, values: gtsam.Values, jacobians: list[Any] | None) -> Array:
        value, jacobian = residual(pose_of(values, key, WHAT))
        if jacobians is not None:
            jacobians[0] = np.asfortranarray(jacobian)
        return value

    return gtsam.CustomFactor(noise, [key], error)


def _chordal_rotation(noise: gtsam.noiseModel.Base) -> gtsam.noiseModel.Base:
    """Of nine rows, from an isotropic model of three: |R - R_0|_F^2 is 2 theta^2."""
    information = noise_models.information_of(noise_models.without_loss(noise))
    mean = np.trace(information) / 3.0
    if np.abs(information / mean - np.eye(3)).max() > 1e-6:
        raise ValueError(
            "the noise model of the prior's rotation is anisotropic, and the chordal residual holds one sigma; take "
            "residual='geodesic', or Isotropic.Sigma(3, sigma_rad)"
        )
    rows = gtsam.noiseModel.Isotropic.Sigma(9, float(np.sqrt(2.0 / mean)))
    return noise_models.with_loss_of(noise, rows)


def _vec_by_turning(R: Array) -> Array:
    """(9, 3): vec(R Expmap(omega)), columns stacked, by omega."""
    return (R @ _COLUMNS).reshape(9, 3)


def _quaternion_wxyz(R: gtsam.Rot3) -> Array:
    """Unit quaternion with a scalar part >= 0: of the two that are one rotation, the one near 1."""
    omega = gtsam.Rot3.Logmap(R)  # at most half a turn
    half = 0.5 * float(np.linalg.norm(omega))
    return np.concatenate([[np.cos(half)], 0.5 * np.sinc(half / np.pi) * omega])


def _left(q: Array) -> Array:
    """L(q) p = q (x) p, both wxyz."""
    w, v = q[0], q[1:]
    result = np.empty((4, 4))
    result[0, 0], result[0, 1:], result[1:, 0] = w, -v, v
    result[1:, 1:] = w * np.eye(3) + hat(v)
    return result


def _check_residual(residual: str) -> None:
    if residual not in get_args(Residual):
        raise ValueError(f"residual={residual!r} is not one of {', '.join(map(repr, get_args(Residual)))}")


def _vector(value: ArrayLike, name: str) -> Array:
    vector = np.asarray(value, dtype=np.float64)
    if vector.shape != (3,) or not np.isfinite(vector).all():
        raise ValueError(f"{name} is {value!r}; give three finite numbers")
    return vector


def _direction(value: ArrayLike, name: str) -> Array:
    vector = _vector(value, name)
    length = np.linalg.norm(vector)
    if length == 0.0:
        raise ValueError(f"{name} is {vector}, which has no direction")
    unit: Array = vector / length
    return unit


def _finite(value: float, name: str) -> float:
    if not np.isfinite(value):
        raise ValueError(f"{name} is {value}; give a finite number")
    return float(value)


def _positive(value: float, name: str) -> float:
    if not (np.isfinite(value) and value > 0.0):
        raise ValueError(f"{name} is {value}; give a positive number")
    return float(value)
