"""The calibrated frames that are exported and drawn: poses on the carriers, intrinsics, time offsets, topics."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import NamedTuple

from rwhec_factors.se3 import inverse

from gtsam_rwhec.cameras.camera import Camera
from gtsam_rwhec.errors import FrameError, StampError
from gtsam_rwhec.fitting.corners_refined import CornersRefined, RefinedIntrinsics
from gtsam_rwhec.fitting.refined import RefinedPoses
from gtsam_rwhec.fitting.reprojection_record import Intrinsics
from gtsam_rwhec.geometry.poses import Array, one_transform
from gtsam_rwhec.rig.section_types import NAME


class CalibratedFrame(NamedTuple):
    """One frame and its parent: names, and T_parent_child (4, 4) in metres."""

    parent: str
    child: str
    T_parent_child: Array


class CameraLink(NamedTuple):
    """The frame of a camera's body: its name, and T_link_optical (4, 4), metres, which the driver publishes."""

    name: str
    T_link_optical: Array


@dataclass(frozen=True, eq=False)
class RigFrames:
    """Calibrated frames by name, in the order in which they are written.

    Names are written into Python, YAML and XML. They have only characters without a special meaning there: first a
    letter, then letters, digits and _, in parts joined by /.

    Raises
    ------
    FrameError
        A name cannot be a frame's, belongs to two frames, or is not a sensor's; or a topic is not one line of text.
    PoseError
        A transform is not a valid pose.
    StampError
        A time offset is not finite.
    """

    #: sensor_carrier, target_carrier: names of the frames that carry the sensors and the targets
    sensor_carrier: str
    target_carrier: str
    sensors: Mapping[str, Array]  #: dict of str to (4, 4): T_sensorcarrier_sensor, metres
    targets: Mapping[str, Array]  #: dict of str to (4, 4): T_targetcarrier_target, metres
    cameras: Mapping[str, Camera] = field(default_factory=dict)  #: Intrinsics by sensor; may lack a sensor
    #: Where a sensor's intrinsics come from, in words that are written beside them. A missing sensor has its stated
    #: intrinsics
    camera_origins: Mapping[str, str] = field(default_factory=dict)
    #: Time offsets by sensor, seconds: the sensor's stamp t is the carriers' t + offset. A missing offset is 0.
    time_offsets_s: Mapping[str, float] = field(default_factory=dict)
    topics: Mapping[str, str] = field(default_factory=dict)  #: Topics of images by sensor; may lack a sensor
    #: Frames of cameras' bodies by sensor, which are written in the place of the optical frames; may lack a sensor
    links: Mapping[str, CameraLink] = field(default_factory=dict)
    warnings: tuple[str, ...] = ()  #: Why frames should not be used; written into every file
    #: Why frames of the rig file are not here; written into every file
    left_out: Mapping[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        links = [link.name for link in self.links.values()]
        names = [self.sensor_carrier, self.target_carrier, *self.sensors, *self.targets, *links]
        for index, name in enumerate(names):
            if not isinstance(name, str) or not NAME.fullmatch(name):
                raise FrameError(
                    f"{name!r} cannot be the name of an exported frame. A name has first a letter, then letters, "
                    "digits and _, in parts joined by /; rename the frame in the rig file"
                )
            if name in names[:index]:
                raise FrameError(
                    f"{name} is the name of two frames; rename one (each carrier, sensor and target needs its own name)"
                )
        for what in ("cameras", "camera_origins", "time_offsets_s", "topics", "links"):
            for name in getattr(self, what):
                if name not in self.sensors:
                    sensors = ", ".join(self.sensors) or "none"
                    raise FrameError(f"{what} has {name!r}, which is not a sensor; the sensors are {sensors}")
            object.__setattr__(self, what, dict(getattr(self, what)))
        for name, offset in self.time_offsets_s.items():
            if not math.isfinite(offset):
                raise StampError(f"the time offset of {name} is {offset!r}; give finite seconds, or leave it out")
        for name, topic in self.topics.items():
            if not topic or not topic.isprintable():
                raise FrameError(f"the topic of {name} is {topic!r}; give one line of printable characters")
        checked_links = {
            name: link._replace(T_link_optical=one_transform(link.T_link_optical, f"the pose of {name} in {link.name}"))
            for name, link in self.links.items()
        }
        object.__setattr__(self, "links", checked_links)
        # Copies: the checked values cannot change any more.
        for what, carrier in (("sensors", self.sensor_carrier), ("targets", self.target_carrier)):
            given = getattr(self, what)
            checked = {name: one_transform(T, f"the pose of {name} in {carrier}") for name, T in given.items()}
            object.__setattr__(self, what, checked)

    def frames(self) -> Iterator[CalibratedFrame]:
        """Each sensor on the sensors' carrier, or its link, then each target on the targets' carrier."""
        yield from self.sensor_frames()
        for name, T in self.targets.items():
            yield CalibratedFrame(self.target_carrier, name, T)

    def sensor_frames(self) -> Iterator[CalibratedFrame]:
        """Each sensor on the carrier; for a camera with a link, the link, so that the driver's own tf tree stays valid.

        T_carrier_link = T_carrier_optical T_link_optical^-1: with the driver's T_link_optical it composes to the
        calibrated pose, and no frame has two parents.
        """
        for name, T in self.sensors.items():
            link = self.links.get(name)
            if link is None:
                yield CalibratedFrame(self.sensor_carrier, name, T)
            else:
                yield CalibratedFrame(self.sensor_carrier, link.name, T @ inverse(link.T_link_optical))

    def optical_frames(self) -> Iterator[CalibratedFrame]:
        """The optical frame of each camera with a link, on its link, as its driver publishes it."""
        for name, link in self.links.items():
            yield CalibratedFrame(link.name, name, link.T_link_optical)


#: Parameters that are focal lengths and principal points, in pixels; coefficients follow them.
IN_PIXELS = 4
#: Pixels. A focal length that counts as exact has a smaller deviation.
EXACT_PX = 1e-3


def frames_of_refined(
    refined: RefinedPoses | CornersRefined,
    cameras: Mapping[str, Camera] | None = None,
    *,
    sensor_carrier: str = "sensorcarrier",
    target_carrier: str = "targetcarrier",
    warnings: tuple[str, ...] = (),
) -> RigFrames:
    """The frames and cameras of a refinement, for ``rw.rig.export_all``.

    Parameters
    ----------
    refined : Refined, RefinedPoses or CornersRefined
        Of ``rw.refine``, ``rw.read_refined``, ``rw.refine_corners`` or ``rw.calibrate_corners(...).refined``.
    cameras : dict of str to Camera, optional
        Stated intrinsics by sensor, used where none were estimated.
    sensor_carrier, target_carrier : str
        Names of the frames that carry the sensors and the targets.
    warnings : tuple of str
        Written into the head of every file.

    Raises
    ------
    FrameError
        A name cannot be a frame's, or `cameras` has a sensor that `refined` lacks.
    """
    known, origins = known_cameras(cameras or {}, refined.intrinsics)
    return RigFrames(
        sensor_carrier=sensor_carrier,
        target_carrier=target_carrier,
        sensors={name: pose.matrix() for name, pose in refined.Y.items()},
        targets={name: pose.matrix() for name, pose in refined.X.items()},
        cameras=known,
        camera_origins=origins,
        time_offsets_s=refined.time_offsets_s,
        warnings=warnings,
    )


def known_cameras(
    stated: Mapping[str, Camera], estimated: Mapping[str, Intrinsics] | Mapping[str, RefinedIntrinsics]
) -> tuple[dict[str, Camera], dict[str, str]]:
    """The cameras to use by sensor, estimated or else stated; and, in words, where the estimated ones come from."""
    cameras = {**stated, **{name: intrinsics.camera for name, intrinsics in estimated.items()}}
    return cameras, {name: _origin(intrinsics) for name, intrinsics in estimated.items()}


def _origin(intrinsics: Intrinsics | RefinedIntrinsics) -> str:
    if max(intrinsics.standard_deviations[:IN_PIXELS]) < EXACT_PX:
        return "as stated, which count as exact"
    deviations = [
        f"{name} {sigma:.2g}" for name, sigma in zip(intrinsics.names, intrinsics.standard_deviations, strict=True)
    ]
    pixels, coefficients = ", ".join(deviations[:IN_PIXELS]) + " px", deviations[IN_PIXELS:]
    words = f"estimated from the corners, standard deviations {', '.join([pixels, *coefficients])}"
    held = ", ".join(intrinsics.held_by_prior)
    return f"{words}; what was stated holds {held}, not the images" if held else words
