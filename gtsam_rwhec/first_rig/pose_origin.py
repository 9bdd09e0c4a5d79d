"""Where the carriers' poses come from - an arm, motion capture, visual-inertial odometry - and what noise that has.

Names tell most: of frames, of topics, and the messages' schema. The path tells more: how many poses a second there are,
and how smooth it is. All of it is a guess, and is said with its reason.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from rwhec_factors import se3

from gtsam_rwhec.files.rounded_numbers import rounded
from gtsam_rwhec.geometry.trajectory import Trajectory
from gtsam_rwhec.rig.sections import PoseNoise

#: An arm's repeatability is ten times smaller; its absolute errors are of this size.
ARM = PoseNoise(rotation_deg=0.03, translation_mm=0.2)
#: Motion capture with markers 20 cm apart.
MOTION_CAPTURE = PoseNoise(rotation_deg=0.1, translation_mm=0.5)
#: Visual or visual-inertial odometry over a room; it drifts besides.
ODOMETRY = PoseNoise(rotation_deg=0.3, translation_mm=5.0)
#: Words in names of frames and topics, by where poses come from; the first that fits counts.
WORDS: tuple[tuple[str, PoseNoise, frozenset[str]], ...] = (
    ("motion capture", MOTION_CAPTURE, frozenset({
        "vicon", "optitrack", "mocap", "qualisys", "natnet", "phasespace", "vrpn", "motive", "rigidbody", "lighthouse",
    })),
    ("visual-inertial odometry or SLAM", ODOMETRY, frozenset({
        "vio", "odom", "odometry", "slam", "vins", "orb", "msckf", "openvins", "rovio", "basalt", "kimera", "svo",
        "map", "t265", "visual",
    })),
    ("a robot's arm", ARM, frozenset({
        "hand", "tool0", "tool", "flange", "tcp", "ee", "eef", "gripper", "wrist", "link", "wrist3", "link6", "link7",
        "link8", "endeffector", "arm", "robot", "panda", "ur5", "ur10", "ur5e", "ur10e", "iiwa", "kuka", "abb", "fanuc",
    })),
)  # fmt: skip
#: Differences over this many poses see noise, and hardly motion: the third difference of white noise of standard
#: deviation s has standard deviation sqrt(20) s (1 + 9 + 9 + 1).
THIRD_DIFFERENCE = np.sqrt(20.0)
#: A path says how smooth it is with at least this number of poses, at this rate.
LEAST_POSES, LEAST_HZ = 50, 15.0


@dataclass(frozen=True)
class Origin:
    """Where poses come from, as a guess.

    Attributes
    ----------
    noise : PoseNoise or None
        A guess of their noise; None where nothing says what they come from.
    words : str
        The guess with its reasons.
    """

    noise: PoseNoise | None
    words: str


def origin_of(names: Iterable[str], schema: str = "", path: Trajectory | None = None) -> Origin:
    """Guess where poses come from.

    Parameters
    ----------
    names : iterable of str
        Frames and topics; files and folders.
    schema : str
        The messages' schema, if they are of a log.
    path : Trajectory, optional
        The poses.
    """
    names = [name for name in names if name]
    seen = f"; {of_path}" if (of_path := _path_words(path)) else ""
    if "odometry" in schema.lower():
        return Origin(ODOMETRY, f"visual-inertial odometry or SLAM, by the messages' type {schema}{seen}")
    for what, noise, words in WORDS:
        for name in names:
            hits = words & set(re.split(r"[^a-z0-9]+", re.sub(r"([a-z])([A-Z])", r"\1_\2", name).lower()))
            if hits:
                return Origin(noise, f"{what}, by the name {name}{seen}")
    return Origin(None, f"no name tells where the poses come from{seen}")


def smoothness_m(path: Trajectory) -> float:
    """The white noise that positions have at most, metres: that of third differences, which see little motion."""
    third = np.diff(path.T[:, :3, 3], n=3, axis=0)
    return float(np.median(np.abs(third)) / 0.6745 / THIRD_DIFFERENCE)


def _path_words(path: Trajectory | None) -> str:
    """The path's rate, and its smoothness where the rate lets it be seen."""
    if path is None or len(path.stamps_ns) < LEAST_POSES:
        return ""
    rate_hz = 1e9 / float(np.median(np.diff(path.stamps_ns)))
    said = f"{rounded(rate_hz, 2)} poses a second"
    moving = np.linalg.norm(np.diff(path.T[:, :3, 3], axis=0), axis=1).max() > 0.0
    if rate_hz < LEAST_HZ or not moving:
        return said
    return f"{said}, smooth to {rounded(1e3 * smoothness_m(path), 2)} mm"


@dataclass(frozen=True)
class Rest:
    """Whether images were taken at rest, with the reason."""

    at_rest: bool
    words: str


#: Metres a second and radians a second: a carrier that is slower than both stands still.
REST_M_S, REST_RAD_S = 0.003, np.radians(0.5)
#: Nanoseconds on each side of an image's stamp, over which speeds are measured.
SIDE_NS = 50_000_000
#: Poses that are further apart than this (s), and at the images' stamps to this (ns), are those of stations.
STATIONS_S, SAME_NS = 0.5, 10_000_000
#: At most this number of images are compared with all poses.
MOST_COMPARED = 200
#: This share of the images must be at rest, or in motion, for all of them to count as such.
MOST = 0.8


def rest_of(image_ns: np.ndarray, path: Trajectory) -> Rest:
    """Whether the carrier stood still at the images' stamps (n,).

    Poses that are at the images' stamps only, seconds apart, are those of stations: stop and shoot.
    """
    inside = image_ns[(image_ns - SIDE_NS >= path.stamps_ns[0]) & (image_ns + SIDE_NS <= path.stamps_ns[-1])]
    apart_s = 1e-9 * float(np.median(np.diff(path.stamps_ns))) if len(path.stamps_ns) > 1 else np.inf
    nearest = np.abs(path.stamps_ns[:, None] - image_ns[:MOST_COMPARED]).min(axis=0)
    if apart_s > STATIONS_S and np.median(nearest) < SAME_NS:
        return Rest(True, f"poses are {rounded(apart_s, 2)} s apart: the robot stopped for each image")
    if not len(inside):
        return Rest(False, "no image is within the poses' time")
    before, after = path.at(inside - SIDE_NS)[0], path.at(inside + SIDE_NS)[0]
    step = se3.inverse(before) @ after
    seconds = 2e-9 * SIDE_NS
    slow = np.linalg.norm(step[:, :3, 3], axis=1) / seconds < REST_M_S
    slow &= np.linalg.norm(se3.so3_logmap(step[:, :3, :3]), axis=1) / seconds < REST_RAD_S
    share = float(slow.mean())
    said = f"the carrier stood still at {int(slow.sum())} of {len(slow)} images"
    return Rest(share >= MOST, said)
