"""What happens to the gallery's recordings: each function makes one, good or with a fault, of a generator.

How large a fault is comes from the generator too, between what hardly matters and what nobody could miss.
"""

from __future__ import annotations

from dataclasses import replace

import gallery_scene as scene
import numpy as np
from gallery_scene import Recording
from rendered_prints import Array
from rwhec_factors import se3
from scipy.spatial.transform import Rotation

from gtsam_rwhec.cameras.camera import Camera


def stations(rng: np.random.Generator) -> Recording:
    """A good recording at rest."""
    return scene.at_rest(rng, scene.all_around(rng))


def one_axis(rng: np.random.Generator) -> Recording:
    """The hand turns about one axis only, and goes where it likes."""
    n = scene.IMAGES
    tilt, towards = np.radians(rng.uniform(10.0, 25.0)), rng.uniform(0.0, 2.0 * np.pi)
    (T_first,) = scene.looking(np.array([0.55]), np.array([tilt]), np.array([towards]), np.zeros(1), np.zeros((1, 2)))
    # Upright, or up to 30 degrees from it, seen from the base.
    lean, to = np.radians(rng.uniform(0.0, 30.0)), rng.uniform(0.0, 2.0 * np.pi)
    axis = np.array([np.sin(lean) * np.cos(to), np.sin(lean) * np.sin(to), np.cos(lean)])
    turn = Rotation.from_rotvec(axis * np.radians(rng.uniform(-45.0, 45.0, (n, 1)))).as_matrix()
    return scene.at_rest(rng, _in_view(rng, turn @ T_first[:3, :3], rng.uniform(0.48, 0.70, n), 0.05))


def planar(rng: np.random.Generator) -> Recording:
    """The hand stays at one height and turns about the vertical, as a camera on a vehicle."""
    n = scene.IMAGES
    tilt, towards = np.radians(rng.uniform(5.0, 20.0)), rng.uniform(0.0, 2.0 * np.pi)
    (T_first,) = scene.looking(np.array([0.60]), np.array([tilt]), np.array([towards]), np.zeros(1), np.zeros((1, 2)))
    turn = Rotation.from_rotvec([0.0, 0.0, 1.0] * np.radians(rng.uniform(-60.0, 60.0, (n, 1)))).as_matrix()
    recording = scene.at_rest(rng, _in_view(rng, turn @ T_first[:3, :3], np.full(n, 0.60), 0.06))
    return _at_height(recording, float(recording.T_base_hand[:, 2, 3].mean()))


def _at_height(recording: Recording, height_m: float) -> Recording:
    """The hand at one height: what the hand's turning alone moves along the axis is nothing, for any camera on it."""
    T_base_hand, reported = recording.T_base_hand.copy(), recording.reported.copy()
    up = height_m - T_base_hand[:, 2, 3]
    T_base_hand[:, 2, 3] += up
    reported[:, 2, 3] += up
    return replace(recording, T_base_hand=T_base_hand, reported=reported)


def little_rotation(rng: np.random.Generator) -> Recording:
    """The hand goes about, and hardly turns."""
    n = scene.IMAGES
    (T_first,) = scene.looking(
        np.array([0.6]), np.array([0.3]), rng.uniform(0.0, 6.0, 1), np.zeros(1), np.zeros((1, 2))
    )
    most = np.radians(rng.uniform(0.5, 2.0))
    turn = Rotation.from_rotvec(rng.uniform(-most, most, (n, 3))).as_matrix()
    return scene.at_rest(rng, _in_view(rng, turn @ T_first[:3, :3], rng.uniform(0.5, 0.7, n), 0.06))


def _in_view(rng: np.random.Generator, R_board_camera: Array, distance_m: Array, beside_m: float) -> Array:
    """T_board_camera (N, 4, 4) with directions (N, 3, 3) that look at points beside the board's middle."""
    T = se3.pose(R_board_camera, -R_board_camera[:, :, 2] * distance_m[:, None])
    T[:, :2, 3] += rng.uniform(-beside_m, beside_m, (len(T), 2))
    return T


def _step(rng: np.random.Generator, degrees: tuple[float, float], metres: tuple[float, float]) -> Array:
    """A pose (4, 4) away from the identity by an angle and a distance of these ranges, in random directions."""
    axis, along = (v / np.linalg.norm(v) for v in rng.normal(size=(2, 3)))
    return se3.pose(
        Rotation.from_rotvec(axis * np.radians(rng.uniform(*degrees))).as_matrix(), along * rng.uniform(*metres)
    )


def board_moved(rng: np.random.Generator) -> Recording:
    """Somebody pushes the board over the table about half way."""
    good = stations(rng)
    at = round(scene.IMAGES * rng.uniform(0.35, 0.65))
    push = se3.pose(
        Rotation.from_euler("z", rng.choice([-1, 1]) * rng.uniform(1.0, 8.0), degrees=True).as_matrix(), np.zeros(3)
    )
    push[:2, 3] = rng.choice([-1, 1], 2) * rng.uniform(0.008, 0.03, 2)
    T = good.T_base_board.copy()
    T[at:] = T[at:] @ push
    return replace(good, T_base_board=T)


def print_size(rng: np.random.Generator) -> Recording:
    """Printed with "fit to page": smaller by some percent."""
    good = stations(rng)
    return replace(good, size=rng.uniform(0.93, 0.98))


def millimetres(rng: np.random.Generator) -> Recording:
    """The controller reports millimetres, and nobody says so."""
    return replace(stations(rng), poses="mm")


def quaternion_order(rng: np.random.Generator) -> Recording:
    """The file has w first under names that say x first."""
    return replace(stations(rng), poses="wxyz")


def inverted(rng: np.random.Generator) -> Recording:
    """The file has the base seen from the hand."""
    return replace(stations(rng), poses="inverse")


def exchanged(rng: np.random.Generator) -> Recording:
    """The rig file says that the camera stands beside the arm, and the arm holds the board."""
    return replace(stations(rng), carriers=("base", "hand"))


def late_clock(rng: np.random.Generator) -> Recording:
    """Images are stamped when they arrive."""
    good = scene.in_motion(rng)
    assert good.stamps_ns is not None
    late_ns = round(1e9 * rng.uniform(0.03, 0.12))
    return replace(good, stamps_ns=good.stamps_ns + late_ns)


def loose_camera(rng: np.random.Generator) -> Recording:
    """The mount gives way at some moment, and the camera hangs otherwise from then on."""
    good = stations(rng)
    at = round(scene.IMAGES * rng.uniform(0.3, 0.7))
    slip = _step(rng, (1.0, 4.0), (0.002, 0.008))
    T = good.T_hand_camera.copy()
    T[at:] = T[at:] @ slip
    return replace(good, T_hand_camera=T)


def motion_blur(rng: np.random.Generator) -> Recording:
    """The shutter is open for too long while the arm moves."""
    good = scene.in_motion(rng)
    return replace(good, exposure_s=rng.uniform(0.12, 0.25))


def upside_down(rng: np.random.Generator) -> Recording:
    """One image of the folder was turned by half a turn, as viewers do that rotate and save."""
    good = stations(rng)
    return replace(good, turned=(int(rng.integers(scene.IMAGES)),))


def wrong_intrinsics(rng: np.random.Generator) -> Recording:
    """The intrinsics are those of another camera of the same make, and stated as calibrated."""
    good = stations(rng)
    K = good.camera.K.copy()
    K[:2, :2] *= 1.0 + rng.choice([-1, 1]) * rng.uniform(0.02, 0.06)
    K[:2, 2] += rng.choice([-1, 1], 2) * rng.uniform(5.0, 20.0, 2)
    stated = Camera.of(good.camera.width, good.camera.height, "plumb_bob", K.tolist(), list(good.camera.D), "camera")
    return replace(good, stated=stated)


def reached(rng: np.random.Generator) -> Recording:
    """A good recording of stations that the arm reaches."""
    return scene.within_reach(rng)[0]


def bent_link(rng: np.random.Generator) -> Recording:
    """A collision bent the upper arm or the forearm, and the controller does not know."""
    good, joints = scene.within_reach(rng)
    bend, link = np.radians(rng.choice([-1, 1]) * rng.uniform(0.8, 2.0)), int(rng.integers(1, 3))
    twist, length = scene.LONG_ARM.twist_rad.copy(), scene.LONG_ARM.length_m.copy()
    twist[link] += bend
    length[link] += rng.uniform(-0.004, 0.004)
    T_base_hand = replace(scene.LONG_ARM, twist_rad=twist, length_m=length).hand(joints)
    # Who set it up put the board where the camera sees it.
    moved = np.median((T_base_hand - good.T_base_hand)[:, :3, 3], axis=0)
    T_base_board = good.T_base_board.copy()
    T_base_board[:, :3, 3] += moved
    return replace(good, T_base_hand=T_base_hand, T_base_board=T_base_board)
