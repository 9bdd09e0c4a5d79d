"""AX = XB, without a target: a sensor's own motions and its carrier's. Here the equation is A Y = Y B."""

from __future__ import annotations

import gtsam

from rwhec_factors.arguments import check_pose
from rwhec_factors.carrier_pose_variables import between
from rwhec_factors.measurement import Residual, measurement_factor


def hand_eye_factor(
    sensor_key: int,
    A: gtsam.Pose3,
    B: gtsam.Pose3,
    noise: gtsam.noiseModel.Base,
    *,
    scale_key: int | None = None,
    residual: Residual = "geodesic",
) -> gtsam.CustomFactor:
    """The factor of one motion, of the carrier and of the sensor between the same two instants: A Y = Y B.

    The residual, with P = Y^-1 A Y and S(R, t) = (R, s t)::

        geodesic   Log(B^-1 S(P))                                            (6,)
        chordal    [vec(R_A R_Y - R_Y R_B), s (R_A t_Y + t_A - t_Y) - R_Y t_B]   (12,)

    Parameters
    ----------
    sensor_key : int
        Key of Y = T_sensorcarrier_sensor (the X of AX = XB), a Pose3.
    A : gtsam.Pose3
        The carrier's motion, T_before_after; metres. From two of its poses: T_world_before^-1 T_world_after.
    B : gtsam.Pose3
        The sensor's motion, T_before_after; metres (times the scale).
    noise : gtsam.noiseModel.Base
        Noise of B's right perturbation, dimension 6.
    scale_key : int, optional
        Key of a 1-vector s, the factor's last key: t_B = s * (true length), as in a monocular odometry.
    residual : "geodesic" or "chordal"

    Raises
    ------
    TypeError, ValueError
        If A or B is not a valid pose, the factor cannot hold the noise, or two keys are equal.
    """
    check_pose(A, "A")
    return measurement_factor(
        [sensor_key], sensor_key, sensor_key, lambda values: (A, dict), B, noise, scale_key, residual
    )


def pose_hand_eye_factor(
    pose_before_key: int,
    pose_after_key: int,
    sensor_key: int,
    B: gtsam.Pose3,
    noise: gtsam.noiseModel.Base,
    *,
    scale_key: int | None = None,
    residual: Residual = "geodesic",
) -> gtsam.CustomFactor:
    """The factor of a sensor's motion between two poses of its carrier that are variables.

    P_i = T_world_carrier before and P_j after: A = P_i^-1 P_j. The residual is ``hand_eye_factor``'s with this A.

    Parameters
    ----------
    pose_before_key, pose_after_key : int
        Keys of P_i and P_j, Pose3.
    sensor_key, B, noise, scale_key, residual
        As in ``hand_eye_factor``.

    Raises
    ------
    TypeError, ValueError
        As in ``hand_eye_factor``.
    """
    carriers = between(pose_before_key, pose_after_key, ("P_i = T_world_carrier", "P_j = T_world_carrier"))
    keys = [pose_before_key, pose_after_key, sensor_key]
    return measurement_factor(keys, sensor_key, sensor_key, carriers, B, noise, scale_key, residual)
