"""Drop-in GTSAM factors for extrinsics in an existing graph. Imports gtsam and numpy only."""

from rwhec_factors.known_carrier_pose import robot_world_hand_eye_factor

__all__ = ["robot_world_hand_eye_factor"]
