"""What the tests of OpenCV's calls share: its methods by name, and how far answers are apart."""

from __future__ import annotations

import numpy as np

from gtsam_rwhec.methods import opencv

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
