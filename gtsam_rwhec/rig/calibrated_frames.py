"""What is exported: where each sensor and each target is on its carrier, and what else the formats have of a sensor."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import NamedTuple

from gtsam_rwhec.errors import FrameError, StampError
from gtsam_rwhec.geometry.poses import Array, one_transform
from gtsam_rwhec.rig.field_types import NAME
from gtsam_rwhec.vision.camera import Camera


class CalibratedFrame(NamedTuple):
    """One frame and its parent: names, and T_parent_child (4, 4) in metres."""

    parent: str
    child: str
    T_parent_child: Array


@dataclass(frozen=True, eq=False)
class RigFrames:
    """Calibrated frames by name, in the order in which they are written.

    Names go into Python, YAML and XML, so none is taken that means anything there: a letter first, then letters, digits
    and _, parts joined by /.

    Attributes
    ----------
    sensor_carrier, target_carrier : str
        Frames that carry the sensors and the targets.
    sensors : dict of str to (4, 4) array
        T_sensorcarrier_sensor, metres.
    targets : dict of str to (4, 4) array
        T_targetcarrier_target, metres.
    cameras : dict of str to Camera
        Intrinsics by sensor; a sensor may lack them.
    time_offsets_s : dict of str to float
        By sensor: its stamp t is the carriers' t + offset. Left out is 0.
    topics : dict of str to str
        Topics of images by sensor; a sensor may lack one.
    warnings : tuple of str
        Why the frames, or some of them, are not to be used; written into every file.

    Raises
    ------
    FrameError
        A name that cannot be a frame's, that two frames have, or that is no sensor's; a topic that is no line of text.
    PoseError
        A transform that is none.
    StampError
        A time offset that is not finite.
    """

    sensor_carrier: str
    target_carrier: str
    sensors: Mapping[str, Array]
    targets: Mapping[str, Array]
    cameras: Mapping[str, Camera] = field(default_factory=dict)
    time_offsets_s: Mapping[str, float] = field(default_factory=dict)
    topics: Mapping[str, str] = field(default_factory=dict)
    warnings: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        names = [self.sensor_carrier, self.target_carrier, *self.sensors, *self.targets]
        for index, name in enumerate(names):
            if not isinstance(name, str) or not NAME.fullmatch(name):
                raise FrameError(
                    f"{name!r} cannot be the name of an exported frame: a letter first, then letters, digits and _, "
                    "parts joined by /; rename it in the rig file"
                )
            if name in names[:index]:
                raise FrameError(
                    f"{name} is the name of two frames (carriers, sensors and targets each need their own); rename one"
                )
        for what, given in (
            ("cameras", self.cameras),
            ("time_offsets_s", self.time_offsets_s),
            ("topics", self.topics),
        ):
            for name in given:
                if name not in self.sensors:
                    raise FrameError(f"{what} has {name!r}, which is no sensor; the sensors are {_list(self.sensors)}")
        for name, offset in self.time_offsets_s.items():
            if not math.isfinite(offset):
                raise StampError(f"the time offset of {name} is {offset!r}; give finite seconds, or leave it out")
        for name, topic in self.topics.items():
            if not topic or not topic.isprintable():
                raise FrameError(f"the topic of {name} is {topic!r}; give one line of printable characters")
        # Copies, so that what was checked stays as it is.
        for what, carrier in (("sensors", self.sensor_carrier), ("targets", self.target_carrier)):
            given = getattr(self, what)
            checked = {name: one_transform(T, f"the pose of {name} in {carrier}") for name, T in given.items()}
            object.__setattr__(self, what, checked)
        for what in ("cameras", "time_offsets_s", "topics"):
            object.__setattr__(self, what, dict(getattr(self, what)))

    def frames(self) -> Iterator[CalibratedFrame]:
        """Each sensor on its carrier, then each target on its own."""
        for name, T in self.sensors.items():
            yield CalibratedFrame(self.sensor_carrier, name, T)
        for name, T in self.targets.items():
            yield CalibratedFrame(self.target_carrier, name, T)


def _list(names: Mapping[str, Array]) -> str:
    return ", ".join(names) or "none"
