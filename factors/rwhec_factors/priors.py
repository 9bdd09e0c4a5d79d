"""Priors on extrinsics and scales: whole poses, parts of poses, and the regulariser of the DQ paper.

A motion about one axis (a 4-axis robot, a car), or without turning (a Cartesian robot), leaves directions of the
extrinsics free; a known height, tilt or rotation fixes them. ``T`` below is the pose variable, T_carrier_frame =
(R, t): X or Y. Every factor refuses arguments that are not valid with a TypeError or ValueError that names them.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Literal

import gtsam
import numpy as np
from numpy.typing import ArrayLike

from rwhec_factors import noise_models
from rwhec_factors.arguments import (
    check_choice,
    check_pose,
    checked_numbers,
    checked_twists,
    name_of,
    number_of,
    pose_of,
    positive,
    unit_vector,
)
from rwhec_factors.measurement import Residual
from rwhec_factors.se3 import HATS, Array, hat

RotationPenalty = Literal["distance", "imaginary"]


def pose_prior_factor(
    key: int, T: gtsam.Pose3, noise: gtsam.noiseModel.Base, *, residual: Residual = "geodesic"
) -> gtsam.CustomFactor:
    """A prior on a pose: Log(T_0^-1 T) (6,), or the certified cost's [vec(R - R_0), t - t_0] (12,).

    Parameters
    ----------
    key : int
        Key of T, a Pose3.
    T : gtsam.Pose3
        T_0, metres.
    noise : gtsam.noiseModel.Base
        Dimension 6, rotation (rad) first. Geodesic: noise of T_0's right perturbation, in the frame's own axes.
        Chordal: one sigma for rotation (kappa = 1 / (2 sigma^2)) and one sigma for translation.
    residual : "geodesic" or "chordal"
    """
    check_pose(T, "the prior's pose")
    check_choice("residual", residual, Residual)
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
    """A prior on a rotation alone: Log(R_0' R) (3,) rad, or vec(R - R_0) (9,).

    A Cartesian robot needs this prior: its motion does not determine rotations about the direction of travel.

    Parameters
    ----------
    key : int
        Key of T, a Pose3.
    R : gtsam.Rot3
        R_0 = R_carrier_frame.
    noise : gtsam.noiseModel.Base
        Dimension 3, rad, in the frame's own axes. The chordal residual needs isotropic noise, kappa = 1 / (2 sigma^2).
    residual : "geodesic" or "chordal"
    """
    if not isinstance(R, gtsam.Rot3):
        raise TypeError(f"the prior's rotation is a {type(R).__name__}; give a gtsam.Rot3 (T.rotation() of a Pose3)")
    check_choice("residual", residual, Residual)
    model = noise_models.checked(noise, 3, "the prior's rotation")
    R_0 = R.matrix()

    def geodesic(pose: gtsam.Pose3) -> tuple[Array, Array]:
        value = gtsam.Rot3.Logmap(R.between(pose.rotation()))
        return value, np.hstack([gtsam.Rot3.LogmapDerivative(value), np.zeros((3, 3))])

    def chordal(pose: gtsam.Pose3) -> tuple[Array, Array]:
        turned = pose.rotation().matrix()
        return (turned - R_0).ravel(order="F"), np.hstack([_vec_by_turning(turned), np.zeros((9, 3))])

    if residual == "chordal":
        return _prior(key, noise_models.chordal(model, "the prior's rotation"), chordal)
    return _prior(key, model, geodesic)


def position_prior_factor(key: int, t_m: ArrayLike, noise: gtsam.noiseModel.Base) -> gtsam.CustomFactor:
    """A prior on a position alone: t - t_0 (3,), metres.

    Parameters
    ----------
    key : int
        Key of T, a Pose3.
    t_m : (3,) array_like
        t_0, in the carrier's frame.
    noise : gtsam.noiseModel.Base
        Dimension 3, metres, along the carrier's axes. For one or two coordinates take `position_along_prior_factor`.
    """
    t_0 = checked_numbers(t_m, (3,), "the prior's position t_m")
    model = noise_models.checked(noise, 3, "the prior's position")

    def error(pose: gtsam.Pose3) -> tuple[Array, Array]:
        return pose.translation() - t_0, np.hstack([np.zeros((3, 3)), pose.rotation().matrix()])

    return _prior(key, model, error)


def position_along_prior_factor(key: int, axis: ArrayLike, value_m: float, sigma_m: float) -> gtsam.CustomFactor:
    """A prior on one coordinate of a position, for instance a height: axis' t - value (1,), metres.

    Parameters
    ----------
    key : int
        Key of T, a Pose3.
    axis : (3,) array_like
        Direction in the carrier's frame, of any length. [0, 0, 1] is a height on a carrier with z up.
    value_m, sigma_m : float
        The position along the axis and its standard deviation, metres.
    """
    direction = unit_vector(axis, "axis")
    if not np.isfinite(value_m):
        raise ValueError(f"value_m is {value_m}; give a finite number")
    model = gtsam.noiseModel.Isotropic.Sigma(1, positive(sigma_m, "sigma_m"))

    def error(pose: gtsam.Pose3) -> tuple[Array, Array]:
        along = direction @ pose.rotation().matrix()
        return np.array([direction @ pose.translation() - value_m]), np.concatenate([np.zeros(3), along])[None]

    return _prior(key, model, error)


def direction_prior_factor(
    key: int, axis_frame: ArrayLike, axis_carrier: ArrayLike, sigma_rad: float
) -> gtsam.CustomFactor:
    """A prior on a tilt (2,), rad: R axis_frame points along axis_carrier, and a turn about that axis stays free.

    The residual is, with N (3, 2) a basis of the plane orthogonal to axis_frame, and theta the angle between the two
    axes::

        e = theta / sin(theta) N' R' axis_carrier       |e| = theta

    Parameters
    ----------
    key : int
        Key of T, a Pose3.
    axis_frame, axis_carrier : (3,) array_like
        One direction in the frame's axes and in the carrier's axes, of any length. A level camera with z ahead and y
        down has axis_frame [0, 1, 0]. On a carrier with z up its axis_carrier is [0, 0, -1].
    sigma_rad : float
        Standard deviation of each of the two tilts.
    """
    frame, carrier = unit_vector(axis_frame, "axis_frame"), unit_vector(axis_carrier, "axis_carrier")
    model = gtsam.noiseModel.Isotropic.Sigma(2, positive(sigma_rad, "sigma_rad"))
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
        # Exactly opposite, every turn is equally short. Take one, so that an optimiser leaves this point.
        unit = lateral / sine if sine > 1e-8 else np.array([1.0, 0.0])
        radial = along * (unit @ lateral_by) - sine * along_by  # d theta
        sideways = np.eye(2) - np.outer(unit, unit)
        jacobian[:, :3] = np.outer(unit, radial) + (theta / sine if sine > 1e-8 else 0.0) * sideways @ lateral_by
        return theta * unit, jacobian

    return _prior(key, model, error)


def dual_quaternion_prior_factor(
    key: int, T: gtsam.Pose3, a: float, b: float, *, rotation: RotationPenalty = "distance"
) -> gtsam.CustomFactor:
    """The DQ paper's prior (Section 3.3): Q = Q_0 (x) dQ keeps dQ = dq + epsilon dq' near 1.

    The factor's error (half the squared residual) is the paper's term of the cost::

        a |1 - dq|^2 + b |dq'|^2        rotation="distance", eq. 25; the sign of dQ makes the scalar part >= 0
        a dq^T G dq  + b |dq'|^2        rotation="imaginary", eq. 26; G keeps the imaginary parts

    A deviation by an angle theta and a length d has |1 - dq| = 2 sin(theta / 4), the imaginary part sin(theta / 2) and
    |dq'| = d / 2. Near the prior, a and b are sigmas of sqrt(2 / a) rad and sqrt(2 / b) m. Far away "imaginary" pulls
    less and less, and not at all at half a turn; "distance" always pulls.

    Parameters
    ----------
    key : int
        Key of T, a Pose3.
    T : gtsam.Pose3
        Q_0 as a pose, metres.
    a, b : float
        Weights, positive.
    rotation : "distance" or "imaginary"
    """
    check_pose(T, "the prior's pose")
    check_choice("rotation", rotation, RotationPenalty)
    root_a, root_b = np.sqrt(2.0 * positive(a, "a")), np.sqrt(2.0 * positive(b, "b"))
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
    """A prior on a scale: ln(s / s_0) (1,).

    For a tag of 0.160 m +- 1 % and measurements made for 0.160 m: ``log_scale_prior_factor(key, 1.0, 0.01)``.

    Parameters
    ----------
    scale_key : int
        Key of s, a 1-vector: t_B = s * (true length).
    scale, sigma_log : float
        s_0 and the standard deviation of the logarithm, both positive.

    Raises
    ------
    ValueError
        While optimising, if s <= 0, which has no logarithm.
    """
    log_0 = np.log(positive(scale, "scale"))
    model = gtsam.noiseModel.Isotropic.Sigma(1, positive(sigma_log, "sigma_log"))

    def error(factor: gtsam.CustomFactor, values: gtsam.Values, jacobians: list[Any] | None) -> Array:
        s = number_of(values, scale_key, "the scale (measured / true length)")
        if not s > 0.0:
            raise ValueError(
                f"the scale {name_of(scale_key)} is {s}; it must be positive. Start nearer to the answer, and check "
                "that the frames are right-handed (a mirror image of the measurements has a negative scale)"
            )
        if jacobians is not None:
            jacobians[0] = np.array([[1.0 / s]])
        return np.array([np.log(s) - log_0])

    return gtsam.CustomFactor(model, [scale_key], error)


def _prior(
    key: int, noise: gtsam.noiseModel.Base, residual: Callable[[gtsam.Pose3], tuple[Array, Array]]
) -> gtsam.CustomFactor:
    """The factor on one pose with a residual (m,) and its Jacobian (m, 6)."""

    def error(factor: gtsam.CustomFactor, values: gtsam.Values, jacobians: list[Any] | None) -> Array:
        value, jacobian = residual(pose_of(values, key, "an extrinsic T_carrier_frame"))
        if jacobians is not None:
            jacobians[0] = np.asfortranarray(jacobian)
        return value

    return gtsam.CustomFactor(noise, [key], error)


def _vec_by_turning(R: Array) -> Array:
    """The derivative (9, 3) of vec(R Expmap(omega)), columns stacked, by omega."""
    return -(R @ HATS).reshape(9, 3)


def _quaternion_wxyz(R: gtsam.Rot3) -> Array:
    """The unit quaternion of a rotation whose scalar part is >= 0."""
    omega = gtsam.Rot3.Logmap(R)  # at most half a turn
    half = 0.5 * float(np.linalg.norm(omega))
    return np.concatenate([[np.cos(half)], 0.5 * np.sinc(half / np.pi) * omega])


def _left(q: Array) -> Array:
    """The matrix L(q) with L(q) p = q (x) p, both wxyz."""
    w, v = q[0], q[1:]
    result = np.empty((4, 4))
    result[0, 0], result[0, 1:], result[1:, 0] = w, -v, v
    result[1:, 1:] = w * np.eye(3) + hat(v)
    return result


def shifted_pose_prior_factor(
    pose_key: int, time_offset_key: int, T: gtsam.Pose3, twist: ArrayLike, noise: gtsam.noiseModel.Base
) -> gtsam.CustomFactor:
    """A prior on the pose P of a moving carrier: P is the measured pose T, moved on by an unknown time d.

    Several measurements of one instant may share P (``pose_robot_world_hand_eye_factor``).
    The residual is Log((T Expmap(d twist))^-1 P), (6,).

    Parameters
    ----------
    pose_key : int
        Key of P, a Pose3.
    time_offset_key : int
        Key of d, a 1-vector, seconds: the sensor's stamp t is the carriers' t + d.
    T : gtsam.Pose3
        Measured at the stamp, metres.
    twist : (6,)
        [omega (rad/s), v (m/s)] in P's own axes.
    noise : gtsam.noiseModel.Base
        Noise of T's right perturbation, dimension 6, rotation first.

    Raises
    ------
    TypeError, ValueError
        If T, the twist or the noise model is not valid.
    """
    check_pose(T, "the measured pose")
    velocity = checked_twists(twist, (6,))
    model = noise_models.checked(noise, 6, "the measured pose")

    def error(factor: gtsam.CustomFactor, values: gtsam.Values, jacobians: list[Any] | None) -> Array:
        P = pose_of(values, pose_key, "P, the carrier's pose")
        d = number_of(values, time_offset_key, "the time offset in seconds")
        off = T.compose(gtsam.Pose3.Expmap(d * velocity)).inverse().compose(P)
        value: Array = gtsam.Pose3.Logmap(off)
        if jacobians is not None:
            slope = gtsam.Pose3.LogmapDerivative(value)
            jacobians[0] = np.asfortranarray(slope)
            # Expmap(-(d + e) v) = Expmap(-e v) Expmap(-d v): from the left, so Ad(off^-1) brings it to the right.
            jacobians[1] = np.asfortranarray(-slope @ (off.inverse().AdjointMap() @ velocity)[:, None])
        return value

    return gtsam.CustomFactor(model, [pose_key, time_offset_key], error)
