"""The sections of a rig file, field by field; `target_sections` and `intrinsics_section` have the others.

No value is converted, and an unknown key is an error. What a key is, its example, and its unit where its name does not
end with it stand beside the field: the reference (`reference`) and the JSON Schema (`json_schema`) are made of them.
"""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import BeforeValidator, Field, model_validator

from gtsam_rwhec.fitting.fit_options import Stated
from gtsam_rwhec.rig.camera_link import link_of_optical
from gtsam_rwhec.rig.field_types import EulerAxes, FramePair, Name, OrText, Positive, Text, TimeOffset, list_of
from gtsam_rwhec.rig.intrinsics_section import IntrinsicsOrText
from gtsam_rwhec.rig.section import Section, one_of


class PoseNoise(Section):
    """Noise of poses: standard deviations about and along each axis."""

    rotation_deg: Positive = Field(description="standard deviation about each axis", examples=[0.02])
    translation_mm: Positive = Field(description="standard deviation along each axis", examples=[0.2])


class PoseSource(Section):
    """Where the carriers' poses are: in tf (two frames), on a topic, or in files beside the images (frames).

    Poses are T_parent_child. How the numbers of files are meant is stated here where the files do not say it.
    """

    model_config = one_of(
        "tf", "topic", "frames",
        together=(
            ("topic", "parent", "child"), ("parent", "topic"), ("child", "topic"), ("quaternion", "frames"),
            ("euler", "frames"), ("angles", "frames"), ("length", "frames"), ("one_instant", "frames"),
        ),
    )  # fmt: skip

    tf: FramePair | None = Field(
        default=None,
        description="two frames of tf, [parent, child], also over several links",
        examples=[["base", "hand"]],
    )
    topic: Text | None = Field(
        default=None,
        description="a topic of PoseStamped, Odometry or PoseInFrame; with parent and child",
        examples=["/vicon/hand/pose"],
    )
    parent: Name | None = Field(
        default=None, description="with topic: the frame that the poses are in", examples=["world"]
    )
    child: Name | None = Field(
        default=None, description="with topic: the frame that the poses are of", examples=["hand"]
    )
    frames: FramePair | None = Field(
        default=None,
        description="of poses in files beside images, [parent, child]: the files have T_parent_child",
        examples=[["base", "hand"]],
    )
    quaternion: Literal["xyzw", "wxyz"] | None = Field(
        default=None,
        description="with frames: the order of quaternions; without it the files' names of columns or keys "
        "tell, else xyzw",
        examples=["wxyz"],
    )
    euler: EulerAxes | None = Field(
        default=None,
        description="with frames: axes in the order of the turns, capitals about turning axes, small letters "
        "about fixed ones; or rotation_vector. Angles in files are refused without it",
        examples=["ZYX"],
    )
    angles: Literal["degrees", "radians"] | None = Field(
        default=None, description="with euler: the unit of the files' angles", examples=["degrees"]
    )
    length: Literal["m", "mm"] | None = Field(
        default=None,
        description="with frames: the unit of the files' positions; without it names of columns tell, else m",
        examples=["mm"],
    )
    one_instant: bool | None = Field(
        default=None,
        description="with frames, images taken at rest: whether images of one name, of different cameras, are "
        "of one instant",
        examples=[True],
    )

    @property
    def parent_and_child(self) -> tuple[str, str]:
        """The parent and the child frame of the poses."""
        return self.tf or self.frames or (self.parent or "", self.child or "")

    @model_validator(mode="after")
    def _is_one(self) -> PoseSource:
        if len(self._given("tf", "topic", "frames")) != 1:
            raise ValueError(
                "give one of tf: [parent, child], topic: ... (with parent and child), and, for poses in files beside "
                "images, frames: [parent, child]"
            )
        if self.topic is None and self._given("parent", "child"):
            raise ValueError(f"{self._given('tf', 'frames')[0]} names both frames already; leave parent and child out")
        if self.topic is not None and len(self._given("parent", "child")) < 2:
            raise ValueError(f"name the frames of the poses of {self.topic}: parent: ..., child: ...")
        of_files = self._given("quaternion", "euler", "angles", "length", "one_instant")
        if of_files and self.frames is None:
            raise ValueError(f"{', '.join(of_files)}: only for poses in files, with frames: [parent, child]")
        return self


class Carriers(Section):
    """The frame that carries the sensors, the frame that carries the targets, and where their poses are."""

    sensors: Name = Field(
        description="the frame that carries the sensors: the moving one for a camera on a hand, the fixed one for a "
        "camera beside the robot",
        examples=["hand"],
    )
    targets: Name = Field(description="the frame that carries the targets", examples=["base"])
    poses: PoseSource = Field(
        description="where their poses are: {tf: [parent, child]}, {topic, parent, child} or {frames: [parent, child]}",
        examples=[{"tf": ["base", "hand"]}],
    )
    max_gap_s: Positive = Field(
        default=0.2, description="between poses further apart in time nothing is interpolated", examples=[0.1]
    )
    noise: PoseNoise | None = Field(
        default=None,
        description="standard deviations of these poses; leave it out if you do not know them",
        examples=[{"rotation_deg": 0.02, "translation_mm": 0.2}],
    )


class Link(Section):
    """The frame of a camera's body, of which its driver publishes the optical frame: exported in its place."""

    frame: Name = Field(description="the name of that frame", examples=["camera_link"])
    T_link_optical: (
        Annotated[
            tuple[float, float, float, float, float, float, float],
            list_of(7, "[x, y, z, qx, qy, qz, qw], metres and a unit quaternion"),
        ]
        | None
    ) = Field(
        default=None,
        description="pose of the optical frame in it, [x, y, z, qx, qy, qz, qw], as `ros2 run tf2_ros tf2_echo "
        "camera_link camera_optical_frame` prints it; without it that of REP 103: one origin, the link's x "
        "forward, y left, z up",
        examples=[[0.0, 0.015, 0.0, -0.5, 0.5, -0.5, 0.5]],
        json_schema_extra={"unit": "m"},
    )

    @model_validator(mode="after")
    def _is_pose(self) -> Link:
        link_of_optical(self.T_link_optical)
        return self


def _frame_or_section(given: Any) -> Any:
    """A section of a link; text alone is the name of its frame."""
    return {"frame": given} if isinstance(given, str) else given


class Sensor(Section):
    """A camera with images, or with the detections of a driver."""

    model_config = one_of("images", "detections", together=(("images", "intrinsics"), ("poses", "images")))

    images: Text | None = Field(
        default=None,
        description="topic of the camera's images; of a folder of images, their path in it",
        examples=["/cam_left/image"],
    )
    poses: Text | None = Field(
        default=None,
        description="with images in a folder: path of the carriers' poses, one file for all images, a folder "
        "with a file an image, or an index",
        examples=["poses.csv"],
    )
    detections: Text | None = Field(
        default=None, description="topic of a driver's detections, in place of images", examples=["/tag_detections"]
    )
    intrinsics: IntrinsicsOrText | None = Field(
        default=None,
        description="with images: a file, a section, or the word estimate, which needs no calibration but images of a "
        "board; detections with poses need none",
        examples=["left.yaml", {"topic": "/cam_left/camera_info"}, "estimate"],
    )
    time_offset: TimeOffset = Field(
        default=0.0,
        description="the sensor's stamp t is the carriers' t + offset; or the word estimate, which needs a "
        "rotation that speeds up and slows down. Images taken at rest: leave it out",
        examples=["estimate"],
        json_schema_extra={"unit": "s"},
    )
    frame: Name | None = Field(
        default=None,
        description="its frame in the results; without it the sensor's name",
        examples=["cam_left_optical"],
    )
    link: Annotated[Link, BeforeValidator(_frame_or_section), OrText("the name of the frame")] | None = Field(
        default=None,
        description="the frame of a camera's body; it takes the optical frame's place in the files for ROS",
        examples=["camera_link"],
    )

    @property
    def stated(self) -> Stated:
        """Where the stated intrinsics come from; "unknown" where none are stated, or they are to be estimated."""
        return "unknown" if self.intrinsics is None else self.intrinsics.stated_as

    @model_validator(mode="after")
    def _is_one(self) -> Sensor:
        given = self._given("images", "detections")
        if len(given) != 1:
            raise ValueError(
                f"{' and '.join(given) or 'nothing'} given; give one of images (a topic of a log, or a path in a "
                "folder) and detections (a topic); a sensor that knows only its own motion has odometry"
            )
        if self.poses is not None and self.images is None:
            raise ValueError("poses go with images in a folder; poses of detections are in the log")
        if self.images is not None and self.intrinsics is None:
            raise ValueError(
                "images without intrinsics; give FILE, {topic: ...}, {kalibr: ..., camera: ...} or numbers, "
                "{K: [fx, fy, cx, cy], size: [width, height]}; or the word estimate, if the camera sees a board"
            )
        if self.images is None and self.intrinsics is not None and self.intrinsics.estimate is not None:
            raise ValueError(
                "intrinsics: estimate needs images, and a driver's detections do not say their size; state intrinsics"
            )
        return self


class DetectionNoise(Section):
    """Noise of the detections (B): standard deviations about and along each axis, or of a corner in pixels."""

    model_config = one_of(("rotation_deg", "translation_mm"), ("corner_px",))

    rotation_deg: Positive | None = Field(
        default=None, description="standard deviation about each axis; with translation_mm", examples=[0.3]
    )
    translation_mm: Positive | None = Field(
        default=None, description="standard deviation along each axis; with rotation_deg", examples=[3.0]
    )
    corner_px: Positive | None = Field(
        default=None, description="standard deviation of a corner along each axis", examples=[0.1]
    )

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

    min_rotation_deg: Positive = Field(
        default=0.5,
        description="a measurement at which the carriers have turned less and moved less than this since the "
        "one before is left out",
        examples=[1.0],
    )
    min_translation_mm: Positive = Field(default=3.0, description="see min_rotation_deg", examples=[5.0])
    max_rotation_deg_s: Positive | None = Field(
        default=None,
        description="measurements while the carriers turn faster are left out; null: none is",
        examples=[60.0],
    )
    max_translation_m_s: Positive | None = Field(
        default=None,
        description="measurements while the carriers move faster are left out; null: none is",
        examples=[0.5],
    )
    consensus: bool = Field(
        default=True,
        description="whether measurements that disagree with most others are left out before solving",
        examples=[False],
    )
    thin: bool = Field(
        default=True, description="whether standstill is thinned, see min_rotation_deg", examples=[False]
    )
    robust: Literal["none", "huber", "cauchy", "tukey", "geman_mcclure", "gnc"] = Field(
        default="gnc", description="how solving treats outliers; gnc leaves them out", examples=["none"]
    )
