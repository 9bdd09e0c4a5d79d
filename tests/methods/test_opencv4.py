"""Shah and Li in closed form beside OpenCV 4: OpenCV 5 for Python lacks them (tests/detect/test_other_opencv.py)."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from method_problems import general_pair

from gtsam_rwhec.methods import run
from gtsam_rwhec.simulate import Noise, Simulation

METHODS = {"shah2013": "CALIB_ROBOT_WORLD_HAND_EYE_SHAH", "li2010_kronecker": "CALIB_ROBOT_WORLD_HAND_EYE_LI"}


@pytest.mark.parametrize("name", METHODS)
@pytest.mark.parametrize("simulation", [general_pair(), general_pair(Noise(0.05, 60.0), 1), general_pair(seed=3)])
def test_answers_are_opencvs(name: str, simulation: Simulation) -> None:
    ((target, sensor),) = simulation.problem.pairs
    raw = simulation.problem.measurements(target, sensor)
    # OpenCV's A X = Z B: A = T_cam_world, X = T_world_base, Z = T_cam_gripper, B = T_gripper_base.
    R_X, t_X, R_Y, t_Y = cv2.calibrateRobotWorldHandEye(
        raw.A[:, :3, :3], raw.A[:, :3, 3], raw.B[:, :3, :3], raw.B[:, :3, 3], method=getattr(cv2, METHODS[name])
    )
    found = run(name, simulation.problem)
    for pose, R, t in ((found.X[target], R_X, t_X), (found.Y[sensor], R_Y, t_Y)):
        np.testing.assert_allclose(pose.rotation().matrix(), R, atol=1e-9)
        np.testing.assert_allclose(pose.translation(), np.ravel(t), atol=1e-9)
