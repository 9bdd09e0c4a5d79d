"""Two cameras on a robot's hand over a table with four AprilTags and a ChArUco board.

A camera with radial and tangential distortion and a fisheye camera whose clock is 35 ms late, each with 60 images in
half a minute. What is wrong here on purpose besides the clock: the rig file states the board 2.5 % too large, and in
five images of one camera somebody's poster shows a second tag 2.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from cell_scene.cell import START_NS, Cell
from cell_scene.poses import FloatArray, pose, poses, with_robot_noise
from cell_scene.rendering import Disc, Lens, Print, mottled, tag

TAG_M, TAG_MARGIN_M = 0.12, 0.018
#: 7 x 5 squares; the rig file says 41 mm, and markers in proportion.
SQUARES, SQUARE_M, MARKER_M = (7, 5), 0.040, 0.030
STATED_SQUARE_M = 0.041
#: Of a square of the board's picture: so that a marker's 7 modules (3/4 of it) have whole numbers of pixels.
SQUARE_PX = 140
RATE_HZ, SECONDS = 100, 31.0
#: A camera's stamp t is the robot's t + this: cam_wide stamps too early.
OFFSET_S = {"cam_left": 0.0, "cam_wide": 0.035}

LENSES = {
    "cam_left": Lens(
        640,
        480,
        np.array([[520.0, 0.0, 322.0], [0.0, 518.0, 238.0], [0.0, 0.0, 1.0]]),
        np.array([-0.28, 0.09, 0.0008, -0.0005]),
        "radtan",
    ),
    "cam_wide": Lens(
        640,
        480,
        np.array([[365.0, 0.0, 318.0], [0.0, 364.0, 243.0], [0.0, 0.0, 1.0]]),
        np.array([-0.02, 0.006, -0.004, 0.0008]),
        "equidistant",
    ),
}
T_HAND_CAMERA = {
    "cam_left": pose((4.0, -7.0, 88.0), (0.055, 0.030, 0.045)),
    "cam_wide": pose((-6.0, 5.0, -3.0), (-0.060, 0.010, 0.090)),
}
#: The tags lie on wedges, so that they are not all in one plane.
T_BASE_TARGET = {
    "tag_0": pose((3.0, -4.0, 20.0), (0.38, 0.23, 0.010)),
    "tag_1": pose((-10.0, 6.0, -35.0), (0.84, 0.21, 0.030)),
    "tag_2": pose((8.0, 9.0, 70.0), (0.40, -0.25, 0.020)),
    "tag_3": pose((-5.0, -12.0, 130.0), (0.84, -0.23, 0.015)),
    "board": pose((1.0, 2.0, -8.0), (0.60, 0.00, 0.005)),
}
T_BASE_TABLE = pose((0.0, 0.0, 0.0), (0.62, 0.0, -0.02))
#: Images in which the poster is held before cam_left, and where it is in them: a tag 2 that is elsewhere each time.
T_CAMERA_POSTER = {
    i: pose((180.0, 0.0, 0.0), (x, y, 0.42)) @ pose(turn)
    for i, x, y, turn in (
        (11, 0.06, -0.11, (14.0, 8.0, 15.0)),
        (12, 0.09, -0.10, (-10.0, 18.0, 25.0)),
        (33, -0.12, -0.08, (20.0, -12.0, -60.0)),
        (34, -0.10, -0.10, (6.0, 22.0, -75.0)),
        (35, -0.07, -0.11, (-18.0, -9.0, -95.0)),
    )
}
POSTER_TAG_M, POSTER_MARGIN_M = 0.07, 0.02


def prints() -> dict[str, Print]:
    """What is printed on each target, and the table under them."""
    things = {name: tag(int(name[4:]), TAG_M, TAG_MARGIN_M) for name in T_BASE_TARGET if name.startswith("tag_")}
    markers = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_5X5_100)
    board = cv2.aruco.CharucoBoard(SQUARES, SQUARE_M, MARKER_M, markers)
    picture = board.generateImage((SQUARES[0] * SQUARE_PX, SQUARES[1] * SQUARE_PX), marginSize=0)
    things["board"] = Print(picture / 255.0, SQUARES[0] * SQUARE_M, 0.015)
    things["table"] = mottled(2.0, 1.8, low=0.25, high=0.5, seed=3)
    return things


class HandCameras(Cell):
    """The cell of robot_cell.mcap."""

    file = "robot_cell.mcap"
    #: With it both logs together stay below 5.5 MB.
    jpeg_quality = 80
    lenses = LENSES
    offset_s = OFFSET_S
    images, period_s = 60, 0.5
    #: Over the table, to one side.
    lamp = np.array([0.35, -0.30, 1.60])
    first_stream = 0

    def __init__(self, seed: int) -> None:
        super().__init__(seed)
        self._prints = prints()

    @staticmethod
    def hand(t_s: FloatArray) -> FloatArray:
        """T_base_hand (N, 4, 4) at seconds (N,): over the table, looking down.

        Each axis turns with frequencies of its own, so that at no time the hand turns about one axis alone: +-30
        degrees about x and y (what keeps the table in view) and +-50 about the line of sight. Rotation about two axes
        at least is what makes hand-eye calibration unique; speeds that change (up to 40 deg/s and 0.4 m/s) tell a time
        offset from a displacement of the camera; translation along all three axes is what tells a target's size.
        """
        about_x = 0.42 * np.sin(0.91 * t_s) + 0.10 * np.sin(2.3 * t_s + 1.0)
        about_y = 0.40 * np.sin(0.73 * t_s + 0.8) + 0.08 * np.cos(2.9 * t_s)
        about_z = 0.70 * np.sin(0.37 * t_s + 0.3) + 0.15 * np.sin(1.7 * t_s)
        # The hand goes to where it looks away from, so that the table stays in view.
        x = 0.60 - 0.55 * about_y + 0.05 * np.sin(1.3 * t_s)
        y = -0.05 - 0.55 * about_x + 0.05 * np.cos(1.1 * t_s)
        z = 0.64 + 0.12 * np.sin(0.53 * t_s + 0.5)
        T = poses(np.column_stack([about_x, about_y, about_z]), np.column_stack([x, y, z]))
        T[:, :3, :3] = np.diag([1.0, -1.0, -1.0]) @ T[:, :3, :3]  # looking down
        return T

    def camera(self, name: str, t_s: float) -> FloatArray:
        """T_base_camera (4, 4): the hand carries it."""
        return self.hand(np.array([t_s]))[0] @ T_HAND_CAMERA[name]

    def things(self, camera: str, number: int, T_camera_base: FloatArray) -> list[tuple[Print, FloatArray]]:
        """The targets, the table, and the poster in some images."""
        things = [(self._prints[name], T_camera_base @ T) for name, T in T_BASE_TARGET.items()]
        things.append((self._prints["table"], T_camera_base @ T_BASE_TABLE))
        if camera == "cam_left" and number in T_CAMERA_POSTER:
            poster = Print(self._prints["tag_2"].picture, POSTER_TAG_M, POSTER_MARGIN_M)
            things.append((poster, T_CAMERA_POSTER[number]))
        return things

    def hidden(self, number: int, generator: np.random.Generator) -> Disc | None:
        """Something in every fifth image: tags with hidden corners, boards of which a part is seen."""
        place = generator.uniform([0.1, 0.1, 0.04], [0.9, 0.65, 0.09])
        return Disc(*place.tolist()) if number % 5 == 3 else None


def robot(seed: int) -> tuple[NDArray[np.int64], FloatArray]:
    """Stamps (N,) and T_base_hand (N, 4, 4) as the robot reports them, with its noise."""
    t = np.arange(round(RATE_HZ * SECONDS)) / RATE_HZ
    generator = np.random.default_rng([seed, len(LENSES)])
    return START_NS + np.rint(t * 1e9).astype(np.int64), with_robot_noise(HandCameras.hand(t), generator)
