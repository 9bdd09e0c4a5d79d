"""A X = Y B with a known carrier pose A: extrinsics as the only variables."""

from __future__ import annotations

from typing import Any

import gtsam
import numpy as np


def robot_world_hand_eye_factor(
    target_key: int, sensor_key: int, A: gtsam.Pose3, B: gtsam.Pose3, noise: gtsam.noiseModel.Base
) -> gtsam.CustomFactor:
    """Tie a target's and a sensor's extrinsics by one measurement, with the residual in B's own frame.

    ::

        e(X, Y) = Log(B^-1 Y^-1 A X)        (6,), rotation (rad) first, then translation (m)

    is what a right perturbation of B would have to be for A X = Y B to hold, so that any 6 x 6 covariance of B, in
    GTSAM's order, is honoured as it is.

    Parameters
    ----------
    target_key : int
        Key of X = T_targetcarrier_target, a Pose3.
    sensor_key : int
        Key of Y = T_sensorcarrier_sensor, a Pose3.
    A : gtsam.Pose3
        T_sensorcarrier_targetcarrier, known; metres.
    B : gtsam.Pose3
        T_sensor_target, measured; metres.
    noise : gtsam.noiseModel.Base
        Of B, dimension 6; robust ones too.

    Raises
    ------
    ValueError
        For a noise model of another dimension, or one key for both frames.
    """
    if noise.dim() != 6:
        raise ValueError(f"the noise model has dimension {noise.dim()}; B's right perturbation has 6")
    if target_key == sensor_key:
        raise ValueError(f"target and sensor have one key, {gtsam.DefaultKeyFormatter(target_key)}; X and Y differ")
    B_inverse = B.inverse()

    def error(factor: gtsam.CustomFactor, values: gtsam.Values, jacobians: list[Any] | None) -> np.ndarray:
        X, Y = (values.atPose3(key) for key in list(factor.keys()))
        predicted = Y.inverse().compose(A.compose(X))  # B as the extrinsics would have it
        residual: np.ndarray = gtsam.Pose3.Logmap(B_inverse.compose(predicted))
        if jacobians is not None:
            # Log(E exp(d)) = e + Jr^-1(e) d; X exp(d) moves E by d, Y exp(d) by -Ad(predicted^-1) d.
            right = gtsam.Pose3.LogmapDerivative(residual)
            jacobians[0] = right
            jacobians[1] = -right @ predicted.inverse().AdjointMap()
        return residual

    return gtsam.CustomFactor(noise, [target_key, sensor_key], error)
