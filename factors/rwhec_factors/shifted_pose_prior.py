"""A carrier's pose as it was measured, at a clock that is off by an unknown time."""

from __future__ import annotations

from typing import Any

import gtsam
import numpy as np
from numpy.typing import ArrayLike

from rwhec_factors import noise_models
from rwhec_factors.known_carrier_pose import checked_twist
from rwhec_factors.measurement import check_pose
from rwhec_factors.se3 import Array
from rwhec_factors.values import number_of, pose_of


def shifted_pose_prior_factor(
    pose_key: int, time_offset_key: int, T: gtsam.Pose3, twist: ArrayLike, noise: gtsam.noiseModel.Base
) -> gtsam.CustomFactor:
    """A measured pose T of a carrier that moves: P is where it was an unknown time d later.

    For P a variable that several measurements of one instant share (``pose_robot_world_hand_eye_factor``), while the
    sensor's clock is off: what the carrier reported at the stamp, moved on by d, is a prior on P.

    Residual: Log((T Expmap(d twist))^-1 P), 6.

    Parameters
    ----------
    pose_key : int
        Of P, a Pose3.
    time_offset_key : int
        Of d, a 1-vector, seconds: the sensor's stamp t is the carriers' t + d.
    T : gtsam.Pose3
        Measured at the stamp, metres.
    twist : (6,)
        [omega (rad/s), v (m/s)] in P's own axes.
    noise : gtsam.noiseModel.Base
        Of T's right perturbation, dimension 6, rotation first.

    Raises
    ------
    TypeError, ValueError
        For what is no pose, twist or noise model.
    """
    check_pose(T, "the measured pose")
    velocity = checked_twist(twist)
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
