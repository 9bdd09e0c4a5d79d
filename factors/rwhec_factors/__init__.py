"""Drop-in GTSAM factors for extrinsics in an existing graph. Imports gtsam and numpy only.

A_i X_j = Y_k B_i: A = T_sensorcarrier_targetcarrier, X = T_targetcarrier_target, Y = T_sensorcarrier_sensor and the
measured B = T_sensor_target. Tangents and covariances are GTSAM's, rotation first, right perturbation; a scale is a
1-vector s with t_B = s * (true length).
"""

from rwhec_factors.batch import (
    BatchResiduals,
    Linearization,
    robot_world_hand_eye_batch_factor,
    robot_world_hand_eye_effects_factor,
    robot_world_hand_eye_effects_factors,
)
from rwhec_factors.edge_summary import EdgeSummary, edge_summary_factor, hand_eye_summary_factor
from rwhec_factors.measurement import (
    hand_eye_factor,
    pose_hand_eye_factor,
    pose_robot_world_hand_eye_factor,
    robot_world_hand_eye_factor,
    two_pose_robot_world_hand_eye_factor,
)
from rwhec_factors.priors import (
    direction_prior_factor,
    dual_quaternion_prior_factor,
    log_scale_prior_factor,
    pose_prior_factor,
    position_along_prior_factor,
    position_prior_factor,
    rotation_prior_factor,
    shifted_pose_prior_factor,
)

__all__ = [
    "BatchResiduals",
    "EdgeSummary",
    "Linearization",
    "direction_prior_factor",
    "dual_quaternion_prior_factor",
    "edge_summary_factor",
    "hand_eye_factor",
    "hand_eye_summary_factor",
    "log_scale_prior_factor",
    "pose_hand_eye_factor",
    "pose_prior_factor",
    "pose_robot_world_hand_eye_factor",
    "position_along_prior_factor",
    "position_prior_factor",
    "robot_world_hand_eye_batch_factor",
    "robot_world_hand_eye_effects_factor",
    "robot_world_hand_eye_effects_factors",
    "robot_world_hand_eye_factor",
    "rotation_prior_factor",
    "shifted_pose_prior_factor",
    "two_pose_robot_world_hand_eye_factor",
]
