"""What is found against a log beside what ``calibrate`` finds, and the lines of the rig file to change."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace

import numpy as np

from gtsam_rwhec.calibration.misreadings import Misreading
from gtsam_rwhec.calibration.reading import Reading
from gtsam_rwhec.calibration.readings import Mistake
from gtsam_rwhec.calibration.task_units import PointUncertainty
from gtsam_rwhec.calibration.verdict import Finding, Ground
from gtsam_rwhec.results.log_history import SizeFields
from gtsam_rwhec.rig import Rig

#: A point that is known to this share of its distance only (with 95 %) is known to nothing.
LARGEST_SHARE = 0.25
#: Other sizes that are estimated, or other clocks, may look like these.
NOT_OF_DIRECTIONS = (Mistake.UNIT, Mistake.SCALE, Mistake.ROWS_SHIFTED)


def is_of_the_poses(misreadings: Sequence[Misreading]) -> bool:
    """Whether poses were misread in a way that neither sizes nor clocks explain: then no round helps."""
    return bool(misreadings) and all(one.mistake not in NOT_OF_DIRECTIONS for one in misreadings)


def in_rig_file(misreadings: Sequence[Misreading], rig: Rig) -> tuple[Misreading, ...]:
    """The misreadings with the cure for a log: the line of the rig file to change, or the messages that are wrong."""
    return tuple(replace(one, cure=_cure(one, rig)) for one in misreadings)


def with_cures(findings: Sequence[Finding], before: tuple[Misreading, ...], rig: Rig) -> tuple[Finding, ...]:
    """The findings, with the cures for a log in that of the misreadings."""
    said, now = Reading(before).finding, Reading(in_rig_file(before, rig)).finding
    return tuple(now if now is not None and finding == said else finding for finding in findings)


def not_of_late_clocks(findings: Sequence[Finding], misreadings: Sequence[Misreading]) -> tuple[Finding, ...]:
    """The findings without those that late clocks make, which rotations tell better: large residuals, shifted rows."""
    made = {Ground.IMPLAUSIBLE, Ground.COVARIANCE_DOUBTED, Ground.LATE_CLOCK}
    if all(one.mistake is Mistake.ROWS_SHIFTED for one in misreadings):
        made.add(Ground.MISREAD)
    return tuple(finding for finding in findings if finding.ground not in made)


def not_of_marked_outliers(findings: Sequence[Finding]) -> tuple[Finding, ...]:
    """The findings without measurements that look wrong: outliers were looked for, under each detection's own noise."""
    return tuple(finding for finding in findings if finding.ground is not Ground.OUTLIERS_KEPT)


def _cure(misreading: Misreading, rig: Rig) -> str:
    carriers, place = rig.carriers, rig.source.place
    of_A = "A is inverted" in misreading.likely
    if carriers.poses.frames is not None and (cure := _cure_of_files(misreading.mistake, of_A, rig)):
        return cure
    if misreading.mistake is Mistake.INVERTED and of_A:
        parent, child = carriers.poses.parent_and_child
        exchange = (
            f"if {carriers.targets} carries the sensors, exchange the two names in "
            f"{place(('carriers', 'sensors'), ('carriers', 'targets'))}"
        )
        if carriers.poses.topic is not None:
            return (
                f"{exchange}; if it does not, topic {carriers.poses.topic} has poses of {parent} in {child}: exchange "
                f"parent and child in {place(('carriers', 'poses', 'parent'))}"
            )
        return f"{exchange}; if it does not, what publishes tf writes the inverse of T_{parent}_{child}"
    if misreading.mistake is Mistake.INVERTED:
        topics = ", ".join(sensor.detections for sensor in rig.sensors.values() if sensor.detections is not None)
        return f"let the driver publish the target's pose in the sensor's frame (topics {topics})" if topics else (
            misreading.cure
        )  # fmt: skip
    if misreading.mistake is Mistake.ROWS_SHIFTED:
        lines = place(*(("sensors", name, "time_offset") for name in rig.sensors))
        return f"write time_offset: estimate ({lines})"
    if misreading.mistake is Mistake.SCALE:
        return (
            f"measure the targets again ({place(('targets',))}), or write sizes: estimate; or the carriers' unit of "
            "length or the focal lengths are wrong"
        )
    if misreading.mistake is Mistake.QUATERNION_ORDER:
        return "ROS and Foxglove messages have quaternions as x, y, z, w: correct what publishes these poses"
    return misreading.cure


def _cure_of_files(mistake: Mistake, of_A: bool, rig: Rig) -> str:
    """The cure where the carriers' poses are in files beside images; empty where it is the same as for a log."""
    carriers, place = rig.carriers, rig.source.place
    poses, key = carriers.poses, place(("carriers", "poses"))
    if mistake is Mistake.QUATERNION_ORDER:
        other = "xyzw" if poses.quaternion == "wxyz" else "wxyz"
        return f"write quaternion: {other} beside the frames ({key}); where the files name their columns, rename those"
    if mistake is Mistake.INVERTED and of_A:
        parent, child = poses.parent_and_child
        return (
            f"if {carriers.targets} carries the sensors, exchange the two names in "
            f"{place(('carriers', 'sensors'), ('carriers', 'targets'))}; if it does not, the files have "
            f"T_{child}_{parent}: write frames: [{child}, {parent}] ({key})"
        )
    if mistake is Mistake.ROWS_SHIFTED and all(sensor.time_offset == 0.0 for sensor in rig.sensors.values()):
        paths = ", ".join(f"{sensor.images} with {sensor.poses}" for sensor in rig.sensors.values())
        return (
            f"poses belong to other images than those of their names or order ({paths}): compare both, first and last; "
            "where the names are stamps, write time_offset: estimate"
        )
    return ""


def estimated_sizes(sizes: Sequence[SizeFields], rig: Rig) -> list[Finding]:
    """Stated sizes that were to be checked, that the motion contradicts, and that were estimated in their place.

    Where another stated size fits the motion, the carriers' unit and the focal lengths are right, and the poses rest
    on it. Where none does, any of the three may be wrong.
    """
    if rig.sizes != "check":
        return []
    told = [size for size in sizes if size.sigma is not None]
    doubted = [size for size in told if size.is_doubted and size.is_free]
    if not doubted:
        return []
    words = ", ".join(
        f"{size.target} is {abs(size.percent_too_large):.2g} % too {'large' if size.scale > 1.0 else 'small'} "
        f"({rig.source.place(('targets', size.target))}: the motion says {1e3 * size.stated_m / size.scale:.2f} mm)"
        for size in doubted
    )
    if len(doubted) == len(told):
        said = "the stated size of" if len(doubted) == 1 else "no stated size fits the motion:"
        why = "the poses use the sizes that the motion gives, and nothing tells whether the sizes are wrong or the "
        return [
            Finding(Ground.SIZE_DOUBTED, f"{said} {words}; {why}carriers' unit of length or the focal lengths")
        ]  # fmt: skip
    return [Finding(Ground.SIZE_ESTIMATED, f"the stated size of {words}; the poses use the size that the motion gives")]


def known_to_nothing(points: Iterable[PointUncertainty], rig: Rig) -> list[Finding]:
    """Points that are known no better than by a part of their distance: what was stated does not fit together.

    Noise that is as large as this is no camera's. Wrong intrinsics of all cameras look like it.
    """
    findings = []
    for point in points:
        distance_mm = 1e3 * float(np.linalg.norm(point.point_m))
        if np.isfinite(point.radius_mm) and point.radius_mm > LARGEST_SHARE * distance_mm:
            place = rig.source.place(("sensors", point.frame, "intrinsics"))
            words = (
                f"a point {1e-3 * distance_mm:.2f} m from {point.frame} is known to {point.radius_mm:.0f} mm only, and "
                f"that is no noise of a camera: intrinsics ({place}), sizes and the carriers' poses do not fit together"
            )
            findings.append(Finding(Ground.IMPLAUSIBLE, words))
    return findings
