"""Whether the cameras are on the moving frame or beside it: both are solved for, and the residuals compared.

With poses T_base_hand, a camera on the hand that sees targets beside the robot has A = T_hand_base; a camera beside the
robot that sees targets on the hand has A = T_base_hand. Only one of them explains what the camera saw, where the motion
is rich enough. Scales are free, because sizes of targets are guesses here.

Poses that are given as T_hand_base look the same as exchanged roles: A is then inverted too. No measurement tells these
two apart; the frames' names in the log do, or a person.
"""

from __future__ import annotations

import math
import re
from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from rwhec_factors import se3

from gtsam_rwhec.calibration.trial_fits import TrialFit, fitted
from gtsam_rwhec.cameras.board_turns import choose_turns, turns_about_z
from gtsam_rwhec.cameras.camera import Camera
from gtsam_rwhec.cameras.plane_ambiguity import choose_over_time
from gtsam_rwhec.cameras.targets import Checkerboard, CircleGrid, Tag, Target, family_named
from gtsam_rwhec.detect.detections import Detection
from gtsam_rwhec.detect.detector import Detector
from gtsam_rwhec.errors import CameraError, LogError, PoseError, StampError, TransformError
from gtsam_rwhec.files.terminal_text import rounded
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.geometry.trajectory import Trajectory
from gtsam_rwhec.logs import Log, TfBuffer
from gtsam_rwhec.problem.measurements import Pair
from gtsam_rwhec.problem.problem import Problem
from gtsam_rwhec.rig.log_contents import DriverTopic, LogContents
from gtsam_rwhec.rig.sections import PoseNoise, PoseSource, Sensor

#: A pair of a sensor and a target needs at least this number of images.
LEAST_IMAGES = 6
#: At most this number of pairs, those with the most images, are solved for.
MOST_PAIRS = 12
#: One role fits far better if the product of its rotation and translation residuals is smaller by this factor.
FAR_BETTER = 9.0
#: The better role's residuals must also be below these limits: rotation (rad), translation (m).
EXPLAINED_RAD, EXPLAINED_M = math.radians(3.0), 0.05
#: The assumed standard deviation of a corner, pixels, if nobody has measured it.
CORNER_PX = 0.3
#: Images get stamps this far apart, nanoseconds; their own are not used.
STEP_NS = 10**9

Role = Literal["child", "parent"]


@dataclass(frozen=True, eq=False)
class Seen:
    """A target in one image of a sensor, and the carriers' pose at that time."""

    sensor: str
    target: Target
    detection: Detection
    T: Array  #: (4, 4), T_parent_child of the poses


@dataclass(frozen=True, eq=False)
class RoleEvidence:
    """The residuals of both roles."""

    #: child, parent: the robust fit if the sensors are on the child of the poses, or on their parent; None without an
    #: answer
    child: TrialFit | None
    parent: TrialFit | None
    images: int  #: The number of measurements

    @property
    def role(self) -> Role | None:
        """Which of the poses' frames carries the sensors; None if the data cannot tell."""
        if self.child is None or self.parent is None:
            return None
        better, worse = sorted((self.child, self.parent), key=_product)
        explains = better.residual.rotation_rad < EXPLAINED_RAD and _translation_m(better) < EXPLAINED_M
        tells = explains and _product(worse) > FAR_BETTER * _product(better)
        return None if not tells else "child" if better is self.child else "parent"

    @property
    def product(self) -> float:
        """The product of both residuals of the better role; infinite without an answer."""
        return min((_product(fit) for fit in (self.child, self.parent) if fit is not None), default=math.inf)

    def explains_far_better(self, other: RoleEvidence) -> bool:
        """Whether one role explains these measurements, with far smaller residuals than both roles of ``other``."""
        return self.role is not None and other.product > FAR_BETTER * self.product

    @property
    def sizes(self) -> dict[str, float]:
        """True over guessed length of each target, by the fit of the role; empty if the role is unknown."""
        fit = {"child": self.child, "parent": self.parent, None: None}[self.role]
        if fit is None or not isinstance(fit.scale, dict):
            return {}
        return {name: 1.0 / scale for name, scale in fit.scale.items() if scale > 0.0}

    def in_words(self, parent: str, child: str) -> str:
        """The residuals of both roles, in one phrase."""
        return (
            f"solved both ways over {self.images} measurements, the median residual is {_figures(self.child)} with the "
            f"cameras on {child}, and {_figures(self.parent)} with them on {parent}"
        )


def evidence_of_roles(seen: Iterable[Seen]) -> RoleEvidence:
    """Solve for both roles, with free scales."""
    tracks: dict[Pair, list[Seen]] = defaultdict(list)
    for one in seen:
        if one.detection.rejection is None and np.isfinite(one.T).all():
            tracks[Pair(one.target.name, one.sensor)].append(one)
    chosen = sorted((pair for pair in tracks if len(tracks[pair]) >= LEAST_IMAGES), key=lambda p: -len(tracks[p]))
    chosen = chosen[:MOST_PAIRS]
    images = sum(len(tracks[pair]) for pair in chosen)
    fits = []
    for on_child in (True, False):
        sample = {pair: _track(tracks[pair], on_child) for pair in chosen}
        fits.append(fitted(Problem("per_target"), sample) if chosen else None)
    return RoleEvidence(fits[0], fits[1], images)


def _product(fit: TrialFit) -> float:
    """The product of both residuals, the translations in true lengths."""
    return max(fit.residual.rotation_rad, 1e-6) * max(_translation_m(fit), 1e-9)


def _translation_m(fit: TrialFit) -> float:
    """The residual in true lengths, metres."""
    return fit.residual.translation_m / abs(fit.one_scale)


def _figures(fit: TrialFit | None) -> str:
    if fit is None:
        return "none, for want of an answer,"
    mm = 1e3 * _translation_m(fit)
    return f"{rounded(math.degrees(fit.residual.rotation_rad), 2)} deg and {rounded(mm, 2)} mm"


def _track(seen: Sequence[Seen], on_child: bool) -> tuple[Array, Array]:
    """A = T_sensorcarrier_targetcarrier and B = T_sensor_target: of its candidates and turns, those that fit A."""
    poses = np.array([one.T for one in seen])
    A = se3.inverse(poses) if on_child else poses
    T, squared, covariance = (
        np.array([getattr(one.detection, name) for one in seen]) for name in ("T", "squared_px", "covariance")
    )
    board = seen[0].target
    if isinstance(board, (Checkerboard, CircleGrid)) and board.ways > 1:
        which = choose_turns(T, covariance, squared, CORNER_PX, A, board.ways).which
        T = T.copy()
        T[..., :3, :3] = np.nan_to_num(T[..., :3, :3], nan=0.0) @ turns_about_z(board.ways)[which][:, None]
    stamps = STEP_NS * np.arange(1, len(seen) + 1)
    best = choose_over_time(stamps, T, squared, covariance, CORNER_PX, A).which
    return A, T[np.arange(len(T)), best]


#: Seconds. Poses that are further apart in time are not interpolated.
MAX_GAP_S = 0.5
#: The assumed covariance of a driver's poses if nobody states it: 0.6 degrees and 10 mm.
OF_DRIVER = 1e-4 * np.eye(6)


@dataclass(frozen=True, eq=False)
class LogEvidence:
    """The evidence in a log about its carriers."""

    roles: RoleEvidence  #: What solving with the cameras on either frame says
    rest: dict[str, Rest]  #: By topic of images, whether they were taken at rest; empty where the poses do not tell
    origin: Origin  #: Where the poses come from
    path: Trajectory | None  #: T_parent_child


def evidence_of_log(
    log: Log, contents: LogContents, source: PoseSource, sensors: Mapping[str, Sensor], targets: list[Target]
) -> LogEvidence:
    """Solve for both roles with the poses that `source` names, and examine their path."""
    parent, child = source.parent_and_child
    path = _path(log, contents, source)
    schema = next((topic.schema for topic in contents.topics if topic.name == source.topic), "")
    origin = origin_of([source.topic or "", parent, child], schema, path)
    if path is None:
        return LogEvidence(evidence_of_roles([]), {}, origin, None)
    rest = {
        topic.topic: rest_of(np.unique(np.array(topic.stamps_ns, dtype=np.int64)), path)
        for topic in contents.images.values()
        if len(topic.stamps_ns) > 1
    }
    return LogEvidence(evidence_of_roles(_seen(contents, path, sensors, targets)), rest, origin, path)


def _path(log: Log, contents: LogContents, source: PoseSource) -> Trajectory | None:
    """T_parent_child over time; None if the log's poses do not contain it."""
    parent, child = source.parent_and_child
    try:
        if source.topic is not None:
            series = log.poses(source.topic)
            last = np.append(np.diff(series.stamps_ns) != 0, True)
            return Trajectory.of(series.stamps_ns[last], series.T[last], f"topic {source.topic}")
        buffer = TfBuffer(log.records([t.name for t in contents.topics if t.is_tf and not t.unreadable]))
        stamps = buffer.stamps(parent, child)
        T, gap_s = buffer.at(parent, child, stamps)
        known = np.isfinite(gap_s)
        return Trajectory.of(stamps[known], T[known], f"tf {parent} to {child}")
    except (LogError, TransformError, StampError, PoseError):
        return None  # calibration says what is wrong with them


def _seen(
    contents: LogContents, path: Trajectory, sensors: Mapping[str, Sensor], targets: list[Target]
) -> Iterator[Seen]:
    by_name = {target.name: target for target in targets}
    for name, sensor in sensors.items():
        if sensor.images is not None:
            topic = contents.images[sensor.images]
            camera = _camera(contents, sensor)
            if camera is None or not topic.pictures:
                continue
            found = Detector(camera, targets)(topic.pictures)
            at = path.at(np.array(topic.places, dtype=np.int64))
            for T, gap_s, of_image in zip(*at, found, strict=True):
                if gap_s < MAX_GAP_S:
                    yield from (Seen(name, by_name[d.target], d, T) for d in of_image.detections)
        elif sensor.detections is not None:
            yield from _of_driver(name, contents.drivers[sensor.detections], path, targets)


def _of_driver(sensor: str, driver: DriverTopic, path: Trajectory, targets: list[Target]) -> Iterator[Seen]:
    tags = {(target.family, target.id): target for target in targets if isinstance(target, Tag)}
    for record in driver.kept:
        target = tags.get((family_named(record.family) or "tag36h11", int(record.id)))
        if target is None or record.T_camera_tag is None:
            continue
        T, gap_s = path.at(np.array([record.stamp_ns]))
        if gap_s[0] < MAX_GAP_S:
            poses = np.stack([record.T_camera_tag, np.full((4, 4), np.nan)])
            detection = Detection(
                target.name, np.zeros((4, 2)), np.arange(4), poses, np.array([0.0, np.nan]), np.zeros(2),
                np.stack([OF_DRIVER, OF_DRIVER]), np.nan, np.nan,
            )  # fmt: skip
            yield Seen(sensor, target, detection, T[0])


def _camera(contents: LogContents, sensor: Sensor) -> Camera | None:
    """The camera in the sensor's topic of intrinsics; None if there is no such camera."""
    record = contents.cameras.get((sensor.intrinsics and sensor.intrinsics.topic) or "")
    if record is None:
        return None
    try:
        return Camera.of(record.width, record.height, record.model, record.K, record.D, f"topic {record.topic}")
    except CameraError:
        return None


#: An arm's repeatability is ten times smaller; its absolute errors are of this size.
ARM = PoseNoise(rotation_deg=0.03, translation_mm=0.2)
#: Motion capture with markers 20 cm apart.
MOTION_CAPTURE = PoseNoise(rotation_deg=0.1, translation_mm=0.5)
#: Visual or visual-inertial odometry over a room, without its drift.
ODOMETRY = PoseNoise(rotation_deg=0.3, translation_mm=5.0)
#: Words in names of frames and topics, by the source of poses that they suggest; the first word that fits counts.
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
#: Third differences contain noise and hardly any motion. White noise of standard deviation s gives them the standard
#: deviation sqrt(20) s (20 = 1 + 9 + 9 + 1).
THIRD_DIFFERENCE = np.sqrt(20.0)
#: The smoothness of a path is computed from at least this number of poses, at this rate or more.
LEAST_POSES, LEAST_HZ = 50, 15.0


@dataclass(frozen=True)
class Origin:
    """The guessed source of poses."""

    noise: PoseNoise | None  #: The guessed noise of the poses; None if their source is unknown
    words: str  #: The guess with its reasons


def origin_of(names: Iterable[str], schema: str = "", path: Trajectory | None = None) -> Origin:
    """Guess where poses come from, by the names of frames, topics and files, the messages' schema, and the path."""
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
    """An upper bound on the positions' white noise, metres, by third differences, which contain little motion."""
    third = np.diff(path.T[:, :3, 3], n=3, axis=0)
    return float(np.median(np.abs(third)) / 0.6745 / THIRD_DIFFERENCE)


def _path_words(path: Trajectory | None) -> str:
    """The path's rate, and its smoothness where the rate is high enough."""
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


def first_time_offset(rest: Rest | None) -> tuple[float | Literal["estimate"], str]:
    """A sensor's first time offset, and the comment beside it; `rest` is None if nothing tells about it."""
    if rest is not None and rest.at_rest:
        return 0.0, f"s; a guess: {rest.words}, so no clock is estimated"
    seen = "" if rest is None else f"{rest.words}; "
    return "estimate", f"{seen}or seconds, 0.0 for one clock (estimate needs rotation that speeds up and slows down)"


#: A carrier that is slower than both stands still: metres a second and radians a second.
REST_M_S, REST_RAD_S = 0.003, np.radians(0.5)
#: Nanoseconds on each side of an image's stamp, over which speeds are measured.
SIDE_NS = 50_000_000
#: The robot stopped for each image if poses are further apart than this (s) and this near to images' stamps (ns).
STATIONS_S, SAME_NS = 0.5, 10_000_000
#: At most this number of images are compared with all poses.
MOST_COMPARED = 200
#: This share of the images must be at rest, or in motion, for all of them to count as such.
MOST = 0.8


def rest_of(image_ns: np.ndarray, path: Trajectory) -> Rest:
    """Whether the carrier stood still at the images' stamps (n,).

    If poses exist only at the images' stamps, seconds apart, the robot stopped for each image.
    """
    inside = image_ns[(image_ns - SIDE_NS >= path.stamps_ns[0]) & (image_ns + SIDE_NS <= path.stamps_ns[-1])]
    apart_s = 1e-9 * float(np.median(np.diff(path.stamps_ns))) if len(path.stamps_ns) > 1 else np.inf
    nearest = np.abs(path.stamps_ns[:, None] - image_ns[:MOST_COMPARED]).min(axis=0)
    if apart_s > STATIONS_S and np.median(nearest) < SAME_NS:
        return Rest(True, f"poses are {rounded(apart_s, 2)} s apart: the robot stopped for each image")
    if not len(inside):
        return Rest(False, "no image is within the poses' time")
    turning, moving = path.speeds(inside, SIDE_NS)
    slow = (moving < REST_M_S) & (turning < REST_RAD_S)
    share = float(slow.mean())
    said = f"the carrier stood still at {int(slow.sum())} of {len(slow)} images"
    return Rest(share >= MOST, said)
