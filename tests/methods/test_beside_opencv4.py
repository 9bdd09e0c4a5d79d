"""The calls with OpenCV's names beside OpenCV 4's own: OpenCV 5 lacks them (tests/detect/test_other_opencv.py)."""

import cv2
import numpy as np
import pytest
from hand_eye_stations import METHODS, ROBOT_WORLD, SHAPES, largest_difference, parts, stations
from rwhec_factors.se3 import pose
from scipy.spatial.transform import Rotation

from gtsam_rwhec.methods import opencv


@pytest.mark.parametrize("eye", ["in hand", "to hand"])
@pytest.mark.parametrize("method", METHODS)
def test_hand_eye_agrees_with_the_installed_opencv(method, eye):
    constant = METHODS[method]
    assert constant == getattr(cv2, f"CALIB_HAND_EYE_{method.upper()}")
    for seed, (count, spread_rad, noise_rad) in enumerate(SHAPES):
        gripper, seen, _, _ = stations(count, seed, noise_rad, noise_rad, spread_rad)
        if eye == "to hand":  # the same equation with the base's pose in the gripper first
            seen = stations_to_hand(gripper, seed)
            gripper = np.linalg.inv(gripper)
        ours = opencv.calibrateHandEye(*parts(gripper, seen), method=constant)
        assert largest_difference(ours, cv2.calibrateHandEye(*parts(gripper, seen), method=constant)) < 1e-9


def stations_to_hand(gripper, seed):
    """Target in a fixed camera, the target being on the gripper."""
    rng = np.random.default_rng(seed)
    camera, target = pose(Rotation.random(2, random_state=rng).as_matrix(), rng.normal(size=(2, 3)))
    noise = pose(Rotation.from_rotvec(0.01 * rng.normal(size=(len(gripper), 3))).as_matrix(), np.zeros(3))
    return np.linalg.inv(camera) @ gripper @ target @ noise


@pytest.mark.parametrize("method", ROBOT_WORLD)
def test_robot_world_agrees_with_the_installed_opencv(method):
    constant = ROBOT_WORLD[method]
    assert constant == getattr(cv2, f"CALIB_ROBOT_WORLD_HAND_EYE_{method.upper()}")
    for seed, (count, spread_rad, noise_rad) in enumerate(SHAPES):
        gripper, seen, _, _ = stations(count, seed, noise_rad, noise_rad, spread_rad)
        poses = parts(seen, np.linalg.inv(gripper))
        ours = opencv.calibrateRobotWorldHandEye(*poses, method=constant)
        assert largest_difference(ours, cv2.calibrateRobotWorldHandEye(*poses, method=constant)) < 1e-9
