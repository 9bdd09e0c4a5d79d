"""A first rig file for a log without images and detections, in which several sensors say how they moved."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

from gtsam_rwhec.files.yaml_lines import KeyPath
from gtsam_rwhec.first_rig.log_contents import PoseTopic
from gtsam_rwhec.first_rig.names import free_name
from gtsam_rwhec.rig.field_types import is_name, is_text
from gtsam_rwhec.rig.odometry_section import OdometrySensor, OdometrySource
from gtsam_rwhec.rig.rig import Rig
from gtsam_rwhec.rig.written_rig import rig_text

#: Words of topics that say what is published, and not by which sensor.
OF_KIND = ("odom", "odometry", "pose", "poses", "odometry_pose", "pose_stamped", "local", "filtered")
#: Names that point to visual odometry of one camera, whose lengths are not metres.
OF_ONE_CAMERA = ("mono", "vo", "cam", "camera", "orb", "dso", "svo")
_SCALE = (
    "scale: estimate, inside odometry, where its lengths are not metres (visual odometry of one camera); "
    "time_offset: 0.0 for one clock"
)


@dataclass(frozen=True)
class _Found:
    name: str
    topic: PoseTopic

    @property
    def may_lack_scale(self) -> bool:
        return any(word in self.name.lower().split("_") for word in OF_ONE_CAMERA)


def propose_odometries(poses: Iterable[PoseTopic], where: str) -> tuple[str, tuple[str, ...]] | None:
    """The text of a rig file, and what was seen; None with fewer than two topics of poses that move.

    `where` is the log's name, for the head of the file. Poses in tf are of the robot's own tree, and are not proposed.
    """
    found = _found(poses)
    if len(found) < 2:
        return None
    with_scale = [one for one in found if not one.may_lack_scale] or found
    reference = max(with_scale, key=lambda one: one.topic.count)
    remarks: dict[KeyPath, str] = {
        ("reference",): "TODO a guess: the sensor in whose frame you want the others; its lengths must be metres"
    }
    sensors: dict[str, OdometrySensor] = {}
    for one in found:
        is_reference = one is reference
        sensors[one.name] = OdometrySensor(
            odometry=OdometrySource(topic=one.topic.topic), time_offset=0.0 if is_reference else "estimate"
        )
        if one.may_lack_scale:
            remarks["sensors", one.name, "odometry"] = f"TODO {_SCALE}"
    rig = Rig(sensors={**sensors}, reference=reference.name)  # type: ignore[call-arg]
    head = (
        f"# A first rig file, made from the log {where if is_text(where) else repr(where)}: it has no images and no "
        "detections,\n# and several topics of poses, each taken as what one sensor says of its own motion.\n"
        "# A vehicle that moves in a plane does not tell heights: add given: {heights_m: {SENSOR: 0.5, ...}}.\n"
    )
    notes = tuple(
        f"moves: {one.name}, topic {one.topic.topic}, {one.topic.count} poses, up to {one.topic.motion()[0]:.2g} m "
        "from the first"
        for one in found
    )
    return head + rig_text(rig, remarks), (*notes, f"reference: {reference.name} (of those with metres, most poses)")


def _found(poses: Iterable[PoseTopic]) -> list[_Found]:
    by_topic: dict[str, list[PoseTopic]] = {}
    for series in poses:
        if not series.is_tf:
            by_topic.setdefault(series.topic, []).append(series)
    taken: set[str] = set()
    found = []
    for topic, (series, *others) in by_topic.items():
        if others or not series.is_moving or not is_text(topic):
            continue
        name = free_name(_name(topic), taken)
        taken.add(name)
        found.append(_Found(name, series))
    return found


def _name(topic: str) -> str:
    """The sensor's name: the topic without what says what is published."""
    parts = [part for part in topic.strip("/").split("/") if part]
    while len(parts) > 1 and parts[-1].lower() in OF_KIND:
        parts.pop()
    name = "_".join(parts)
    return name if is_name(name) else "odometry"
