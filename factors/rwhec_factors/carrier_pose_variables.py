"""A X = Y B with the carriers' poses as variables of the user's own graph."""

from __future__ import annotations

from typing import Literal

import gtsam
import numpy as np

from rwhec_factors.arguments import check_choice
from rwhec_factors.measurement import CarrierJacobians, Carriers, Residual, measurement_factor
from rwhec_factors.values import pose_of

Carrier = Literal["sensorcarrier_in_targetcarrier", "targetcarrier_in_sensorcarrier"]


def pose_robot_world_hand_eye_factor(
    pose_key: int,
    target_key: int,
    sensor_key: int,
    B: gtsam.Pose3,
    noise: gtsam.noiseModel.Base,
    *,
    scale_key: int | None = None,
    residual: Residual = "geodesic",
    pose: Carrier = "sensorcarrier_in_targetcarrier",
) -> gtsam.CustomFactor:
    """The factor of one measurement from a carrier whose pose P is a variable, such as a robot's in a SLAM graph.

    With ``pose="sensorcarrier_in_targetcarrier"`` (the default) P = T_targetcarrier_sensorcarrier, for instance
    T_world_robot: A = P^-1. With "targetcarrier_in_sensorcarrier" P = T_sensorcarrier_targetcarrier = A itself, for
    instance T_base_hand where the target is on the hand. The residual is ``robot_world_hand_eye_factor``'s with this A.

    Parameters
    ----------
    pose_key : int
        Key of P, a Pose3.
    target_key : int
        Key of X = T_targetcarrier_target, a Pose3.
    sensor_key : int
        Key of Y = T_sensorcarrier_sensor, a Pose3.
    B : gtsam.Pose3
        T_sensor_target, measured; metres (times the scale).
    noise : gtsam.noiseModel.Base
        Noise of B's right perturbation, dimension 6.
    scale_key : int, optional
        Key of a 1-vector s, the factor's last key: t_B = s * (true length).
    residual : "geodesic" or "chordal"
    pose : "sensorcarrier_in_targetcarrier" or "targetcarrier_in_sensorcarrier"

    Raises
    ------
    TypeError, ValueError
        If B is not a valid pose, the factor cannot hold the noise, or two keys are equal.
    """
    check_choice("pose", pose, Carrier)
    inverted = pose == "sensorcarrier_in_targetcarrier"
    what = "P = T_targetcarrier_sensorcarrier" if inverted else "P = T_sensorcarrier_targetcarrier"

    def carriers(values: gtsam.Values) -> tuple[gtsam.Pose3, CarrierJacobians]:
        P = pose_of(values, pose_key, what)
        # (P Expmap(d))^-1 = P^-1 Expmap(-Ad(P) d)
        if inverted:
            return P.inverse(), lambda: {pose_key: -P.AdjointMap()}
        return P, lambda: {pose_key: np.eye(6)}

    keys = [pose_key, target_key, sensor_key]
    return measurement_factor(keys, target_key, sensor_key, carriers, B, noise, scale_key, residual)


def two_pose_robot_world_hand_eye_factor(
    sensorcarrier_key: int,
    targetcarrier_key: int,
    target_key: int,
    sensor_key: int,
    B: gtsam.Pose3,
    noise: gtsam.noiseModel.Base,
    *,
    scale_key: int | None = None,
    residual: Residual = "geodesic",
) -> gtsam.CustomFactor:
    """The factor of one measurement where both carriers move: a robot's camera sees a tag on another robot.

    P_i = T_world_sensorcarrier and P_j = T_world_targetcarrier in one common frame: A = P_i^-1 P_j. The residual is
    ``robot_world_hand_eye_factor``'s with this A.

    Parameters
    ----------
    sensorcarrier_key, targetcarrier_key : int
        Keys of P_i and P_j, Pose3.
    target_key, sensor_key, B, noise, scale_key, residual
        As in ``pose_robot_world_hand_eye_factor``.

    Raises
    ------
    TypeError, ValueError
        As in ``pose_robot_world_hand_eye_factor``.
    """
    names = ("P_i = T_world_sensorcarrier", "P_j = T_world_targetcarrier")
    carriers = between(sensorcarrier_key, targetcarrier_key, names)
    keys = [sensorcarrier_key, targetcarrier_key, target_key, sensor_key]
    return measurement_factor(keys, target_key, sensor_key, carriers, B, noise, scale_key, residual)


def between(first_key: int, second_key: int, names: tuple[str, str]) -> Carriers:
    """A = P_i^-1 P_j of two pose variables; ``names`` describe them in errors."""

    def carriers(values: gtsam.Values) -> tuple[gtsam.Pose3, CarrierJacobians]:
        A = pose_of(values, first_key, names[0]).between(pose_of(values, second_key, names[1]))
        # (P_i Expmap(d))^-1 P_j = A Expmap(-Ad(A^-1) d)
        return A, lambda: {first_key: -A.inverse().AdjointMap(), second_key: np.eye(6)}

    return carriers
