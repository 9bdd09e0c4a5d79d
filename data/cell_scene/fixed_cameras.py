"""Two fixed cameras that look at a robot's hand, which carries an AprilTag.

The same robot, seen from outside. Its driver publishes the arm link by link, so that base to hand is a chain: two links
that move and a tool's mount that does not. Nothing is wrong here: clocks agree, the tag has its size.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from cell_scene.cell import START_NS, Cell
from cell_scene.poses import FloatArray, pose, poses, with_robot_noise
from cell_scene.rendering import Lens, Print, mottled, tag

TAG_ID, TAG_M, TAG_MARGIN_M = 7, 0.10, 0.02
RATE_HZ, SECONDS = 50, 16.0
LENSES = {
    "cam_front": Lens(
        640,
        480,
        np.array([[610.0, 0.0, 315.0], [0.0, 611.0, 246.0], [0.0, 0.0, 1.0]]),
        np.array([-0.22, 0.06, -0.0006, 0.0009]),
        "radtan",
    ),
    "cam_side": Lens(
        640,
        480,
        np.array([[520.0, 0.0, 324.0], [0.0, 519.0, 236.0], [0.0, 0.0, 1.0]]),
        np.array([0.03, -0.012, 0.004, -0.0006]),
        "equidistant",
    ),
}


def looking(eye: tuple[float, float, float], at: tuple[float, float, float], roll_deg: float) -> FloatArray:
    """T_base_camera (4, 4) of a camera at `eye` that looks at `at`, its x axis level but for the roll."""
    z = np.subtract(at, eye)
    z /= np.linalg.norm(z)
    x = np.cross(z, [0.0, 0.0, 1.0])
    x /= np.linalg.norm(x)
    T = np.eye(4)
    T[:3, :3] = np.column_stack([x, np.cross(z, x), z])
    T[:3, 3] = eye
    return T @ pose((0.0, 0.0, roll_deg))


T_BASE_CAMERA = {
    "cam_front": looking((1.35, -0.10, 0.72), (0.52, -0.03, 0.50), 4.0),
    "cam_side": looking((0.80, -0.78, 0.62), (0.51, 0.00, 0.52), -6.0),
}
#: The tag is on the hand's side.
T_HAND_TAG = pose((93.0, 4.0, 7.0), (0.015, -0.060, -0.030))
#: Between the cameras and a little up.
FACING = np.array([0.75, -0.65, 0.25])
#: Clocks agree.
OFFSET_S = {"cam_front": 0.0, "cam_side": 0.0}
T_FLANGE_HAND = pose((0.0, 0.0, 45.0), (0.0, 0.0, 0.12))
T_WORLD_BASE = pose((0.0, 0.0, 30.0), (1.5, -0.4, 0.75))


def _facing(direction: FloatArray) -> FloatArray:
    """R_base_tag (3, 3) of a tag that faces a direction, with its y axis up."""
    z = direction / np.linalg.norm(direction)
    x = np.cross([0.0, 0.0, 1.0], z)
    x /= np.linalg.norm(x)
    return np.column_stack([x, np.cross(z, x), z])


def prints() -> list[tuple[Print, FloatArray, bool]]:
    """What is seen: a print, its T_hand_print (and True) or T_base_print (and False)."""
    wall = mottled(5.0, 2.2, low=0.3, high=0.5, seed=6)
    plate = Print(np.full((170, 170), 0.55), 0.17, 0.0)
    return [
        (tag(TAG_ID, TAG_M, TAG_MARGIN_M), T_HAND_TAG, True),
        (plate, T_HAND_TAG @ pose((0.0, 0.0, 0.0), (0.0, -0.02, -0.004)), True),
        (mottled(2.6, 2.6, low=0.15, high=0.4, seed=5), pose((0.0, 0.0, 0.0), (0.5, 0.0, -0.02)), False),
        (wall, pose((90.0, 0.0, 0.0), (0.0, 1.3, 0.9)), False),
        (wall, pose((0.0, 0.0, 90.0), (-1.2, 0.0, 0.9)) @ pose((90.0, 0.0, 0.0)), False),
    ]


class FixedCameras(Cell):
    """The cell of eye_to_hand.mcap."""

    file = "eye_to_hand.mcap"
    jpeg_quality = 70
    lenses = LENSES
    offset_s = OFFSET_S
    images, period_s = 25, 0.6
    lamp = np.array([0.9, -0.8, 1.9])
    first_stream = 100

    def __init__(self, seed: int) -> None:
        super().__init__(seed)
        self._prints = prints()

    @staticmethod
    def hand(t_s: FloatArray) -> FloatArray:
        """T_base_hand (N, 4, 4) at seconds (N,): the tag keeps its face between the cameras.

        It turns by +-25 degrees about its x and y and +-40 about its z, each with frequencies of its own, and goes
        some 10 cm to all sides.
        """
        about_x = 0.40 * np.sin(1.10 * t_s) + 0.06 * np.cos(2.7 * t_s)
        about_y = 0.34 * np.sin(0.83 * t_s + 0.7) + 0.05 * np.sin(3.1 * t_s)
        about_z = 0.65 * np.sin(0.47 * t_s + 0.4) + 0.12 * np.sin(1.9 * t_s)
        x = 0.52 + 0.10 * np.sin(0.61 * t_s) + 0.03 * np.cos(1.7 * t_s)
        y = -0.02 + 0.12 * np.sin(0.77 * t_s + 1.2)
        z = 0.51 + 0.10 * np.sin(0.93 * t_s + 0.3)
        T_base_tag = poses(np.column_stack([about_x, about_y, about_z]), np.column_stack([x, y, z]))
        T_base_tag[:, :3, :3] = _facing(FACING) @ T_base_tag[:, :3, :3]
        return T_base_tag @ np.linalg.inv(T_HAND_TAG)

    def camera(self, name: str, t_s: float) -> FloatArray:
        """T_base_camera (4, 4): it stands still."""
        return T_BASE_CAMERA[name]

    def things(self, camera: str, number: int, T_camera_base: FloatArray) -> list[tuple[Print, FloatArray]]:
        """The tag on its plate, floor and walls."""
        T_camera_hand = T_camera_base @ self.hand(self.times(camera)[[number]])[0]
        return [(thing, (T_camera_hand if on_hand else T_camera_base) @ T) for thing, T, on_hand in self._prints]


def arm(seed: int) -> tuple[NDArray[np.int64], FloatArray, FloatArray]:
    """Stamps (N,), T_base_link and T_link_flange (N, 4, 4) as the robot reports them: the chain has its noise."""
    t = np.arange(round(RATE_HZ * SECONDS)) / RATE_HZ
    T_base_hand = with_robot_noise(FixedCameras.hand(t), np.random.default_rng([seed, 200]))
    # The first link turns towards the hand, as an arm's first joint does.
    turn = np.arctan2(T_base_hand[:, 1, 3], T_base_hand[:, 0, 3])
    T_base_link = poses(turn[:, None] * np.array([0.0, 0.0, 1.0]), np.array([0.0, 0.0, 0.33]))
    T_link_flange = np.linalg.inv(T_base_link) @ T_base_hand @ np.linalg.inv(T_FLANGE_HAND)
    return START_NS + np.rint(t * 1e9).astype(np.int64), T_base_link, T_link_flange
