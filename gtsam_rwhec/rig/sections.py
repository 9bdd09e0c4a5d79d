"""The sections of a rig file, field by field; `target_sections` and `odometry_sections` have the others.

No value is converted, and an unknown key is an error. What a key is, its example, and its unit where its name does not
end with it stand beside the field: the reference and the JSON Schema (`rig_reference`) are made of them.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Annotated, Any, Literal, TypeAlias

import numpy as np
from pydantic import BeforeValidator, model_validator
from rwhec_factors.se3 import pose

from gtsam_rwhec.cameras.camera import COEFFICIENTS, MODELS, Camera
from gtsam_rwhec.cameras.unknown_intrinsics import Lens
from gtsam_rwhec.fitting.fit_options import ArmAccuracy, Stated
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.geometry.quaternions import to_rotations
from gtsam_rwhec.logs.pose_tables import PoseStatement
from gtsam_rwhec.rig.section_types import (
    EulerAxes,
    FramePair,
    Name,
    Positive,
    Section,
    Text,
    TimeOffset,
    list_of,
    needed,
    one_of,
    optional,
    or_text,
)

#: REP 103: a link's x is forward, y left, z up; an optical frame's z is forward, x right, y down. T_link_optical's R.
R_LINK_OPTICAL = ((0.0, 0.0, 1.0), (-1.0, 0.0, 0.0), (0.0, -1.0, 0.0))
#: The length of a quaternion may differ from 1 by this: drivers print three digits.
UNIT_LENGTH = 5e-3


def link_of_optical(numbers: Sequence[float] | None = None) -> Array:
    """T_link_optical (4, 4), metres: of x, y, z, qx, qy, qz, qw, as ``tf2_echo`` prints them; else that of REP 103.

    Raises `ValueError` if the quaternion is not of length 1.
    """
    if numbers is None:
        return pose(R_LINK_OPTICAL, np.zeros(3))
    given = np.asarray(numbers, dtype=float)
    length = float(np.linalg.norm(given[3:]))
    if abs(length - 1.0) > UNIT_LENGTH:
        words = f"the quaternion {given[3:].tolist()} has the length {length:.4g}"
        raise ValueError(f"{words}; give [x, y, z, qx, qy, qz, qw], metres and a unit quaternion")
    return pose(to_rotations(given[3:] / length), given[:3])


#: The word for intrinsics that nobody states; a file of this name is {file: estimate}.
ESTIMATE = "estimate"


class Intrinsics(Section):
    """Where a camera's intrinsics are: a topic, a Kalibr camchain, another file, numbers in this section, or nowhere.

    `intrinsics: estimate` needs no calibration: they come from the images of a board, and are refined with the poses.
    """

    model_config = one_of(
        "topic", "kalibr", "file", "K", "estimate", "shared",
        together=(("width", "K"), ("height", "K"), ("model", "K"), ("D", "K")),
    )  # fmt: skip

    topic: Text | None = optional("a topic of CameraInfo or CameraCalibration", "/cam_left/camera_info")
    kalibr: Text | None = optional("Kalibr's camchain: the same as file", "camchain.yaml")
    camera: Text | None = optional(
        "with a file of several cameras: the one; without it the one of the sensor's name", "cam0"
    )
    file: Text | None = optional(
        "a file of Kalibr, COLMAP, ROS, OpenCV or plain numbers; intrinsics: FILE is the same in short", "left.yaml"
    )
    model: str | None = optional(
        "with K: what D is: pinhole (no D), radtan (OpenCV, plumb_bob), equidistant (fisheye) or unified (omni, D"
        " is [xi, k1, k2, p1, p2])",
        "radtan",
    )
    width: int | None = optional("with K, in place of size", 640, unit="pixels")
    height: int | None = optional("with K, in place of size", 480, unit="pixels")
    size: Annotated[tuple[int, int], list_of(2, "[width, height] in pixels")] | None = optional(
        "[width, height], with K or with a file that lacks it", [640, 480], unit="pixels"
    )
    K: Annotated[tuple[float, float, float, float], list_of(4, "[fx, fy, cx, cy] in pixels")] | None = optional(
        "[fx, fy, cx, cy]; the middle of the first pixel is at 0, 0", [550.0, 550.0, 320.0, 240.0], unit="pixels"
    )
    D: tuple[float, ...] | None = optional(
        "with model: all of its coefficients in OpenCV's order", [-0.1, 0.02, 0.0, 0.0]
    )
    estimate: Lens | None = optional(
        "no calibration is there: from the images, with this lens model (any: the one that fits); intrinsics: "
        "estimate is {estimate: any} in short. It takes images of a board at different tilts",
        "equidistant",
    )
    shared: Name | None = optional(
        "another sensor that is the same camera, or whose camera is known to have the same intrinsics (a renderer's, "
        "rectified images): one set is estimated for both. Cameras that are stated alike share them without it, where "
        "the images say so",
        "cam_left",
    )
    stated: Literal["exact", "calibration", "nominal"] | None = optional(
        "where they come from, however they are given: calibration (of this camera, with this lens and focus: "
        "right to 0.3 % of the focal length and 3 pixels of the centre), nominal (a data sheet, a driver's "
        "default, another camera of the kind: right to 3 %, and to 30 pixels or 2 % of the width) or exact (they are "
        "held, and their errors are in no standard deviation); nominal without it",
        "calibration",
    )

    @property
    def stated_as(self) -> Stated:
        """Where they come from: nominal unless the rig file says otherwise, unknown if they are to be estimated."""
        return "unknown" if self.estimate is not None else self.stated or "nominal"

    @model_validator(mode="after")
    def _is_one(self) -> Intrinsics:
        of_file = self.file is not None or self.kalibr is not None
        # A file of OpenCV may lack the size of the images.
        numbers = self._given("model", "width", "height", "K", "D", *([] if of_file else ["size"]))
        sources = self._given("topic", "kalibr", "file", "estimate", "shared") + (["numbers"] if numbers else [])
        self._need_one(
            sources,
            "topic, kalibr (with camera), file, numbers (K, size, and model and D with distortion), shared (another "
            "sensor), or estimate alone: the images say the rest",
        )
        if self.estimate is not None and self.stated is not None:
            raise ValueError(f"stated: {self.stated}, and they are to be estimated; leave stated or estimate out")
        if self.shared is not None and self.stated is not None:
            raise ValueError(f"stated: {self.stated}, and {self.shared} has the intrinsics; say it there")
        if self.camera is not None and not of_file:
            raise ValueError("camera goes with a file: {file: camchain.yaml, camera: cam0}")
        if numbers:
            self.camera_of_numbers("these numbers")
        return self

    def camera_of_numbers(self, where: str) -> Camera:
        """The camera of size, K, model and D; `ValueError` if a number is missing or absurd."""
        if self.size is not None and self._given("width", "height"):
            raise ValueError("size has the width and the height already; leave width and height out")
        width, height = self.size or (self.width, self.height)
        if width is None or height is None or self.K is None:
            given = {
                "size: [width, height]": width is not None and height is not None,
                "K: [fx, fy, cx, cy]": self.K is not None,
            }
            missing = " and ".join(name for name, there in given.items() if not there)
            raise ValueError(f"{missing} missing; give all of a calibration, or write intrinsics: estimate")
        if self.model is None and self.D and any(self.D):
            raise ValueError("D without model; say which coefficients these are: model: radtan, equidistant or unified")
        least = COEFFICIENTS[MODELS.get((self.model or "").strip().lower(), "pinhole")][0]
        if len(self.D or ()) < least:
            words = f"model: {self.model}, and D has {len(self.D or ())} numbers; give all in OpenCV's order"
            without = "leave model and D out if the lens has no distortion"
            raise ValueError(f"{words}, {least} at least (0 where one is zero); or {without}")
        fx, fy, cx, cy = self.K
        K = [[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]]
        return Camera.of(width, height, self.model or "pinhole", K, self.D or (), where)


def _as_section(given: Any) -> Any:
    """A section of intrinsics; text alone is a file, or the word estimate."""
    if given == ESTIMATE:
        return {"estimate": "any"}
    return {"file": given} if isinstance(given, str) else given


#: A section, or text alone: a file, or the word estimate.
IntrinsicsOrText: TypeAlias = Annotated[
    Intrinsics, BeforeValidator(_as_section), or_text("a file of intrinsics, or the word estimate")
]


class PoseNoise(Section):
    """Noise of poses: standard deviations about and along each axis."""

    rotation_deg: Positive = needed("standard deviation about each axis", 0.02)
    translation_mm: Positive = needed("standard deviation along each axis", 0.2)


class PoseAccuracy(PoseNoise):
    """How far off poses near each other are alike: standard deviations about and along each axis."""


class PoseSource(Section):
    """Where the carriers' poses are: in tf (two frames), on a topic, or in files beside the images (frames).

    Poses are T_parent_child. How the numbers of files are meant is stated here where the files do not say it.
    """

    model_config = one_of(
        "tf", "topic", "frames",
        together=(
            ("topic", "parent", "child"), ("parent", "topic"), ("child", "topic"), ("quaternion", "frames"),
            ("euler", "frames"), ("angles", "frames"), ("columns", "frames"), ("length", "frames"),
            ("one_instant", "frames"),
        ),
    )  # fmt: skip

    tf: FramePair | None = optional("two frames of tf, [parent, child], also over several links", ["base", "hand"])
    topic: Text | None = optional(
        "a topic of PoseStamped, Odometry or PoseInFrame; with parent and child", "/vicon/hand/pose"
    )
    parent: Name | None = optional("with topic: the frame that the poses are in", "world")
    child: Name | None = optional("with topic: the frame that the poses are of", "hand")
    frames: FramePair | None = optional(
        "of poses in files beside images, [parent, child]: the files have T_parent_child", ["base", "hand"]
    )
    quaternion: Literal["xyzw", "wxyz"] | None = optional(
        "with frames: the order of quaternions; without it the files' names of columns or keys tell, else xyzw", "wxyz"
    )
    euler: EulerAxes | None = optional(
        "with frames: axes in the order of the turns, capitals about turning axes, small letters about fixed "
        "ones; or rotation_vector. Angles in files are refused without it",
        "ZYX",
    )
    angles: Literal["degrees", "radians"] | None = optional("with euler: the unit of the files' angles", "degrees")
    columns: tuple[Text, ...] | None = optional(
        "with frames: what the columns of a table without a line of names are: tx, ty, tz with qx, qy, qz, qw, or with "
        "rx, ry, rz; without it a position, then a rotation",
        ["rx", "ry", "rz", "tx", "ty", "tz"],
    )
    length: Literal["m", "mm"] | None = optional(
        "with frames: the unit of the files' positions; without it names of columns tell, else m", "mm"
    )
    one_instant: bool | None = optional(
        "with frames, images taken at rest: whether images of one name, of different cameras, are of one instant", True
    )

    @property
    def stated(self) -> PoseStatement:
        """How the numbers of files are meant."""
        columns = None if self.columns is None else " ".join(self.columns)
        return PoseStatement(self.quaternion, self.euler, self.angles, self.length, columns)

    @property
    def parent_and_child(self) -> tuple[str, str]:
        """The parent and the child frame of the poses."""
        return self.tf or self.frames or (self.parent or "", self.child or "")

    @model_validator(mode="after")
    def _is_one(self) -> PoseSource:
        self._need_one(
            self._given("tf", "topic", "frames"),
            "tf: [parent, child], topic: ... (with parent and child), and, for poses in files beside images, frames: "
            "[parent, child]",
        )
        if self.topic is None and self._given("parent", "child"):
            raise ValueError(f"{self._given('tf', 'frames')[0]} names both frames already; leave parent and child out")
        if self.topic is not None and len(self._given("parent", "child")) < 2:
            raise ValueError(f"name the frames of the poses of {self.topic}: parent: ..., child: ...")
        of_files = self._given("quaternion", "euler", "angles", "columns", "length", "one_instant")
        if of_files and self.frames is None:
            raise ValueError(f"{', '.join(of_files)}: only for poses in files, with frames: [parent, child]")
        return self


class Carriers(Section):
    """The frame that carries the sensors, the frame that carries the targets, and where their poses are."""

    sensors: Name = needed(
        "the frame that carries the sensors: the moving one for a camera on a hand, the fixed one for a camera "
        "beside the robot",
        "hand",
    )
    targets: Name = needed("the frame that carries the targets", "base")
    poses: PoseSource = needed(
        "where their poses are: {tf: [parent, child]}, {topic, parent, child} or {frames: [parent, child]}",
        {"tf": ["base", "hand"]},
    )
    max_gap_s: Positive = optional("between poses further apart in time nothing is interpolated", 0.1, default=0.2)
    noise: PoseNoise | None = optional(
        "standard deviations of these poses; leave it out if you do not know them",
        {"rotation_deg": 0.02, "translation_mm": 0.2},
    )
    accuracy: PoseAccuracy | None = optional(
        "how far off these poses are, alike at poses that are near each other: an arm's absolute accuracy, not its "
        "repeatability. No residual shows it; without it, it is assumed from what varies with the arm's configuration",
        {"rotation_deg": 0.05, "translation_mm": 0.5},
    )

    @property
    def arm(self) -> ArmAccuracy | Literal[True]:
        """What is known of errors that poses near each other share."""
        of = self.accuracy
        return True if of is None else ArmAccuracy(math.radians(of.rotation_deg), 1e-3 * of.translation_mm)


class Link(Section):
    """The frame of a camera's body, of which its driver publishes the optical frame: exported in its place."""

    frame: Name = needed("the name of that frame", "camera_link")
    T_link_optical: (
        Annotated[
            tuple[float, float, float, float, float, float, float],
            list_of(7, "[x, y, z, qx, qy, qz, qw], metres and a unit quaternion"),
        ]
        | None
    ) = optional(
        "pose of the optical frame in it, [x, y, z, qx, qy, qz, qw], as `ros2 run tf2_ros tf2_echo camera_link "
        "camera_optical_frame` prints it; without it that of REP 103: one origin, the link's x forward, y left, z"
        " up",
        [0.0, 0.015, 0.0, -0.5, 0.5, -0.5, 0.5],
        unit="m",
    )

    @model_validator(mode="after")
    def _is_pose(self) -> Link:
        link_of_optical(self.T_link_optical)
        return self


def _frame_or_section(given: Any) -> Any:
    """A section of a link; text alone is the name of its frame."""
    return {"frame": given} if isinstance(given, str) else given


class Sensor(Section):
    """A camera with images, or with the detections of a driver; or a 3D camera or LiDAR with clouds of points."""

    model_config = one_of("images", "detections", "clouds", together=(("images", "intrinsics"), ("unit_m", "clouds")))

    images: Text | None = optional(
        "topic of the camera's images; of a folder of images, their path in it", "/cam_left/image"
    )
    clouds: Text | None = optional(
        "topic of a 3D camera's or a LiDAR's clouds (PointCloud2, Foxglove's PointCloud), or of depth images; of a "
        "folder, the path or the pattern of files of clouds: PCD, PLY, NumPy, .bin, or depth images of 16 bits",
        "/camera/depth/points",
    )
    unit_m: Positive | None = optional(
        "with clouds: metres of one unit of theirs; without it 1, and 0.001 for depth images of whole numbers",
        0.001,
        unit="m",
    )
    poses: Text | None = optional(
        "with images or clouds in a folder: path of the carriers' poses, one file for all, a folder with a file an "
        "image, or an index",
        "poses.csv",
    )
    detections: Text | None = optional("topic of a driver's detections, in place of images", "/tag_detections")
    intrinsics: IntrinsicsOrText | None = optional(
        "with images: a file, a section, or the word estimate, which needs no calibration but images of a board; "
        "detections with poses need none, and of clouds only depth images do",
        "left.yaml",
        {"topic": "/cam_left/camera_info"},
        "estimate",
    )
    time_offset: TimeOffset = optional(
        "the sensor's stamp t is the carriers' t + offset; or the word estimate, which needs a rotation that "
        "speeds up and slows down. Images taken at rest: leave it out",
        "estimate",
        default=0.0,
        unit="s",
    )
    frame: Name | None = optional("its frame in the results; without it the sensor's name", "cam_left_optical")
    link: Annotated[Link, BeforeValidator(_frame_or_section), or_text("the name of the frame")] | None = optional(
        "the frame of a camera's body; it takes the optical frame's place in the files for ROS", "camera_link"
    )

    @property
    def shared(self) -> str | None:
        """The sensor that has its intrinsics, if it is another one."""
        return None if self.intrinsics is None else self.intrinsics.shared

    @property
    def stated(self) -> Stated:
        """Where the stated intrinsics come from; "unknown" where none are stated, or they are to be estimated."""
        return "unknown" if self.intrinsics is None else self.intrinsics.stated_as

    @model_validator(mode="after")
    def _is_one(self) -> Sensor:
        self._need_one(
            self._given("images", "detections", "clouds"),
            "images (a topic of a log, or a path in a folder), detections (a topic) and clouds (a topic or a path); a "
            "sensor that knows only its own motion has odometry",
        )
        if self.poses is not None and self.detections is not None:
            raise ValueError("poses go with images or clouds in a folder; poses of detections are in the log")
        if self.unit_m is not None and self.clouds is None:
            raise ValueError("unit_m is the unit of clouds; lengths of targets are in metres")
        if self.clouds is not None and self.time_offset == "estimate":
            raise ValueError("a clock is not estimated from clouds; take them at rest, or state the offset in seconds")
        if self.images is not None and self.intrinsics is None:
            raise ValueError(
                "images without intrinsics; give FILE, {topic: ...}, {kalibr: ..., camera: ...} or numbers, "
                "{K: [fx, fy, cx, cy], size: [width, height]}; or the word estimate, if the camera sees a board"
            )
        if self.images is None and self.intrinsics is not None and self.intrinsics.estimate is not None:
            raise ValueError(
                "intrinsics: estimate needs images of a board, which neither a driver's detections nor clouds are; "
                "state intrinsics"
            )
        return self


class DetectionNoise(Section):
    """Noise of the detections (B): standard deviations about and along each axis, or of a corner in pixels."""

    model_config = one_of(("rotation_deg", "translation_mm"), ("corner_px",))

    rotation_deg: Positive | None = optional("standard deviation about each axis; with translation_mm", 0.3)
    translation_mm: Positive | None = optional("standard deviation along each axis; with rotation_deg", 3.0)
    corner_px: Positive | None = optional("standard deviation of a corner along each axis", 0.1)

    @model_validator(mode="after")
    def _is_one(self) -> DetectionNoise:
        given = self._given("rotation_deg", "translation_mm", "corner_px")
        if given not in (["rotation_deg", "translation_mm"], ["corner_px"]):
            raise ValueError(
                f"{' and '.join(given) or 'nothing'} given; give rotation_deg and translation_mm, or corner_px, or the "
                "word estimate in place of the section"
            )
        return self


class Cleaning(Section):
    """Which measurements cleaning removes before solving; a limit of null removes nothing."""

    min_rotation_deg: Positive = optional(
        "a measurement at which the carriers have turned less and moved less than this since the one before is "
        "left out",
        1.0,
        default=0.5,
    )
    min_translation_mm: Positive = optional("see min_rotation_deg", 5.0, default=3.0)
    max_rotation_deg_s: Positive | None = optional(
        "measurements while the carriers turn faster are left out; null: none is", 60.0
    )
    max_translation_m_s: Positive | None = optional(
        "measurements while the carriers move faster are left out; null: none is", 0.5
    )
    consensus: bool = optional(
        "whether measurements that disagree with most others are left out before solving", False, default=True
    )
    thin: bool = optional("whether standstill is thinned, see min_rotation_deg", False, default=True)
    robust: Literal["none", "huber", "cauchy", "tukey", "geman_mcclure", "gnc"] = optional(
        "how solving treats outliers; gnc leaves them out", "none", default="gnc"
    )
