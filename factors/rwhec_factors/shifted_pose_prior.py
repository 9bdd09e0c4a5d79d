"""A prior on a carrier's pose, where the sensor's clock has an unknown time offset."""

from __future__ import annotations

from typing import Any

import gtsam
import numpy as np
from numpy.typing import ArrayLike

from rwhec_factors import noise_models
from rwhec_factors.arguments import check_pose, checked_twists
from rwhec_factors.se3 import Array
from rwhec_factors.values import number_of, pose_of


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
