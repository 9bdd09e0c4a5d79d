"""Rigs whose frames are exported: two cameras and two targets at any poses, near half turns and gimbal lock too."""

from __future__ import annotations

from typing import Any

import numpy as np
from hypothesis import example, given, settings
from hypothesis import strategies as st
from rwhec_factors import se3
from scipy.spatial.transform import Rotation

from gtsam_rwhec.cameras.camera import Camera
from gtsam_rwhec.rig import RigFrames

K = np.array([[421.5, 0.0, 318.25], [0.0, 420.75, 241.125], [0.0, 0.0, 1.0]])
ANGLES = st.one_of(
    st.floats(-7.0, 7.0),
    # Half turns, gimbal lock, and next to them.
    st.builds(
        lambda quarter, near: quarter * np.pi / 2 + near,
        st.integers(-2, 2),
        st.sampled_from([0.0, 1e-16, -1e-15, 1e-12, -1e-9, 1e-8, 1e-5]),
    ),
)
LENGTHS = st.one_of(st.floats(-20.0, 20.0), st.sampled_from([0.0, -0.0, 1e-5, 1.0, 5e-324]))


@st.composite
def transforms(draw: st.DrawFn) -> np.ndarray:
    return se3.pose(
        Rotation.from_euler("ZYX", [draw(ANGLES), draw(ANGLES), draw(ANGLES)]).as_matrix(),
        [draw(LENGTHS), draw(LENGTHS), draw(LENGTHS)],
    )


def camera(model: str = "radtan", D: Any = (-0.28, 0.07, 1e-5, -2e-4), width: int = 640) -> Camera:
    return Camera.of(width, 480, model, K, D, "test")


def frames_of(poses: list[np.ndarray]) -> RigFrames:
    """A rig of two cameras and two targets at four poses."""
    return RigFrames(
        sensor_carrier="arm/hand",
        target_carrier="base",
        sensors={"cam_left": poses[0], "rig/cam_right": poses[1]},
        targets={"tag_0": poses[2], "board": poses[3]},
        cameras={"cam_left": camera(), "rig/cam_right": camera("equidistant", (0.01, -2e-3, 3e-4, 1e-5), 1280)},
        time_offsets_s={"rig/cam_right": 0.035},
        topics={"cam_left": "/cam_left/image", "rig/cam_right": "it's: a #topic"},
    )


POSES = st.lists(transforms(), min_size=4, max_size=4).map(frames_of)
ONE = frames_of([np.eye(4)] * 4)
EACH_POSE = [settings(max_examples=60, deadline=None), given(POSES), example(ONE)]


def on_random_poses(test: Any) -> Any:
    for decorator in reversed(EACH_POSE):
        test = decorator(test)
    return test
