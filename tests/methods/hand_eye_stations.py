"""Simulated poses for the hand-eye calls, OpenCV's methods by name, its answers, and how far answers are apart.

``python tests/methods/hand_eye_stations.py`` (with opencv-python-headless < 5) writes
``tests/golden/opencv_4_hand_eye.json``: the poses of ``stations(12, seed)`` for the cases in ``CASES`` and OpenCV's
answers to all its methods.
"""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
from rwhec_factors.se3 import pose
from scipy.spatial.transform import Rotation

from gtsam_rwhec.methods import opencv

GOLDEN = Path(__file__).parents[1] / "golden" / "opencv_4_hand_eye.json"
#: name: (seed, rotation noise in rad, translation noise in m, spread of the rotations in rad or None for all)
CASES = {"wide": (1, 0.01, 0.005, None), "narrow": (2, 1e-3, 1e-3, 0.6), "noisy": (3, 0.05, 0.02, 1.0)}


def stations(count, seed, noise_rad=0.01, noise_m=0.005, spread_rad=None):
    """Gripper in base, target in camera (N, 4, 4), and the true camera in gripper and target in base (4, 4)."""
    rng = np.random.default_rng(seed)
    camera, target = pose(Rotation.random(2, random_state=rng).as_matrix(), rng.normal(size=(2, 3)) * 0.3)
    if spread_rad is None:
        turns = Rotation.random(count, random_state=rng)
    else:
        turns = Rotation.from_rotvec(spread_rad * rng.normal(size=(count, 3)))
    gripper = pose(turns.as_matrix(), 0.5 * rng.normal(size=(count, 3)))
    noise = pose(
        Rotation.from_rotvec(noise_rad * rng.normal(size=(count, 3))).as_matrix(), noise_m * rng.normal(size=(count, 3))
    )
    seen = np.linalg.inv(camera) @ np.linalg.inv(gripper) @ target @ noise
    return gripper, seen, camera, target


def parts(*poses):
    """Lists of rotations and translations, as programs that call OpenCV have them."""
    return [part for T in poses for part in (list(T[:, :3, :3]), list(T[:, :3, 3]))]


def main() -> None:
    import cv2

    cases = {}
    for name, (seed, noise_rad, noise_m, spread_rad) in CASES.items():
        gripper, seen, _, _ = stations(12, seed, noise_rad, noise_m, spread_rad)
        base = np.linalg.inv(gripper)
        cases[name] = {
            "gripper2base": gripper.tolist(),
            "target2cam": seen.tolist(),
            "hand_eye": {
                str(method): [part.tolist() for part in cv2.calibrateHandEye(*parts(gripper, seen), method=method)]
                for method in range(5)
            },
            "robot_world": {
                str(method): [
                    part.tolist() for part in cv2.calibrateRobotWorldHandEye(*parts(seen, base), method=method)
                ]
                for method in range(2)
            },
        }
    GOLDEN.write_text(json.dumps({"opencv": cv2.__version__, "cases": cases}, indent=None) + "\n")


METHODS = {
    "tsai": opencv.CALIB_HAND_EYE_TSAI,
    "park": opencv.CALIB_HAND_EYE_PARK,
    "horaud": opencv.CALIB_HAND_EYE_HORAUD,
    "andreff": opencv.CALIB_HAND_EYE_ANDREFF,
    "daniilidis": opencv.CALIB_HAND_EYE_DANIILIDIS,
}
ROBOT_WORLD = {"shah": opencv.CALIB_ROBOT_WORLD_HAND_EYE_SHAH, "li": opencv.CALIB_ROBOT_WORLD_HAND_EYE_LI}
#: Poses, how far they turn, their noise.
SHAPES = [(4, None, 0.01), (9, 0.8, 1e-3), (40, None, 0.1), (25, 1.0, 0.0)]


def largest_difference(ours, theirs):
    return max(np.abs(a - b).max() for a, b in zip(ours, theirs, strict=True))


if __name__ == "__main__":
    main()
