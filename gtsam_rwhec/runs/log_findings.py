"""Findings about a log besides those of ``calibrate``, and the lines of the rig file to change."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace

import numpy as np
from rwhec_factors.se3 import inverse, so3_logmap

from gtsam_rwhec.calibration.misreadings import Misreading
from gtsam_rwhec.calibration.other_readings import Mistake
from gtsam_rwhec.calibration.point_uncertainty import PointUncertainty
from gtsam_rwhec.calibration.verdict import Finding, Ground
from gtsam_rwhec.files.terminal_text import some
from gtsam_rwhec.fitting.refined import Refined
from gtsam_rwhec.problem.measurements import Pair
from gtsam_rwhec.results.log_history import SizeFields
from gtsam_rwhec.rig import Rig
from gtsam_rwhec.runs.measured_pairs import MeasuredPairs
from gtsam_rwhec.runs.run_log import image_name

#: A point whose 95 % radius exceeds this share of its distance counts as unknown.
LARGEST_SHARE = 0.25
#: What to do about it.
OTHER_ANGLES = (
    "write the axes in the order of the turns, capitals for turning axes (ZYX: yaw, pitch, roll) and small letters for "
    "fixed ones (xyz: roll, pitch, yaw), or rotation_vector"
)


def in_rig_file(misreadings: Sequence[Misreading], rig: Rig) -> tuple[Misreading, ...]:
    """The misreadings with what to do for a log: which line of the rig file to change, or which messages are wrong.

    If the rig file exchanges the carriers, A is the inverse of what the rig file says. For one target and one sensor
    this is the same as B inverted, so only one of the two is reported.
    """
    exchanged = [one for one in misreadings if _is_exchange(one, rig)]
    said = [replace(one, likely=_exchange(rig), cure=_unless_carried(rig)) for one in exchanged[:1]]
    is_B = [one.mistake is Mistake.INVERTED and bool(exchanged) for one in misreadings]
    others = [one for one, left_out in zip(misreadings, is_B, strict=True) if one not in exchanged and not left_out]
    if rig.carriers.poses.euler is not None and any(one.mistake.is_of_rotations for one in others):
        of_angles = next(one for one in others if one.mistake.is_of_rotations)
        place = rig.source.place(("carriers", "poses", "euler"))
        likely = f"the files' angles are not euler: {rig.carriers.poses.euler} ({place})"
        return (*said, replace(of_angles, likely=likely, cure=OTHER_ANGLES))
    return (*said, *(replace(one, cure=_cure(one, rig)) for one in others))


def _is_exchange(misreading: Misreading, rig: Rig) -> bool:
    """Whether exchanged carriers explain the misreading. Poses that this library detects are never inverted."""
    if misreading.mistake is Mistake.INVERTED and misreading.inverts_A:
        return True
    from_images = all(sensor.images is not None for sensor in rig.sensors.values())
    return from_images and misreading.mistake in (Mistake.INVERTED, Mistake.ROLES_EXCHANGED)


def _exchange(rig: Rig) -> str:
    place = rig.source.place(("carriers", "sensors"), ("carriers", "targets"))
    return f"exchange `sensors` and `targets` in the rig file ({place})"


def _unless_carried(rig: Rig) -> str:
    """The cure if the rig file has the right carriers: their poses are the inverse of what it says."""
    carriers, place = rig.carriers, rig.source.place
    parent, child = carriers.poses.parent_and_child
    if carriers.poses.frames is not None:
        key = place(("carriers", "poses"))
        cure = f"the files have T_{child}_{parent}: write frames: [{child}, {parent}] ({key})"
    elif carriers.poses.topic is not None:
        key = place(("carriers", "poses", "parent"))
        cure = f"topic {carriers.poses.topic} has poses of {parent} in {child}: exchange parent and child in {key}"
    else:
        cure = f"what publishes tf writes the inverse of T_{parent}_{child}"
    return f"or, if {carriers.sensors} does carry the sensors, {cure}"


def may_be_exchanged(rig: Rig, measurements: int) -> Finding:
    """The finding for too few measurements to notice exchanged carriers or misread poses."""
    place = rig.source.place(("carriers", "sensors"), ("carriers", "targets"))
    return Finding(
        Ground.NO_COVARIANCE,
        f"{measurements} measurements are too few to tell whether the poses were read right, and whether `sensors` and "
        f"`targets` are exchanged ({place}): measure at 10 poses or more",
    )


def _cure(misreading: Misreading, rig: Rig) -> str:
    place = rig.source.place
    also = f"; {_exchange(rig)}" if misreading.inverts_A else ""
    if rig.carriers.poses.frames is not None and (cure := _cure_of_files(misreading.mistake, rig)):
        return cure + also
    if misreading.mistake is Mistake.INVERTED:
        topics = ", ".join(sensor.detections for sensor in rig.sensors.values() if sensor.detections is not None)
        if topics:
            return f"let the driver publish the target's pose in the sensor's frame (topics {topics})"
    if misreading.mistake is Mistake.ROWS_SLIPPED:
        return (
            "compare the stamps, or the numbers, of images and poses from there on (rows count the detections that are "
            "used), and pair them again"
        )
    if misreading.mistake is Mistake.ROWS_SHIFTED:
        lines = place(*(("sensors", name, "time_offset") for name in rig.sensors))
        return f"write time_offset: estimate ({lines})"
    if misreading.mistake is Mistake.SCALE:
        return (
            f"measure the targets again ({place(('targets',))}), or write sizes: estimate; or the carriers' unit of "
            "length or the focal lengths are wrong"
        )
    if misreading.mistake is Mistake.QUATERNION_ORDER:
        return f"ROS and Foxglove messages have quaternions as x, y, z, w: correct what publishes these poses{also}"
    return misreading.cure


def _cure_of_files(mistake: Mistake, rig: Rig) -> str:
    """The cure if the carriers' poses are in files beside images; empty if it is the same as for a log."""
    poses, key = rig.carriers.poses, rig.source.place(("carriers", "poses"))
    if mistake is Mistake.QUATERNION_ORDER:
        other = "xyzw" if poses.quaternion == "wxyz" else "wxyz"
        return f"write quaternion: {other} beside the frames ({key}); where the files name their columns, rename those"
    if mistake is Mistake.ROWS_SHIFTED and all(sensor.time_offset == 0.0 for sensor in rig.sensors.values()):
        paths = ", ".join(f"{sensor.images} with {sensor.poses}" for sensor in rig.sensors.values())
        return (
            f"poses belong to other images than those of their names or order ({paths}): compare both, first and last; "
            "where the names are stamps, write time_offset: estimate"
        )
    return ""


def estimated_sizes(sizes: Sequence[SizeFields], rig: Rig, *, with_intrinsics: bool) -> list[Finding]:
    """Findings about stated sizes that the motion contradicts, and that were estimated instead (``sizes: check``).

    If another stated size fits the motion, the carriers' unit and the focal lengths are right. If none fits, the sizes,
    the unit or the focal lengths may be wrong; the focal lengths only if they were not estimated too.
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
        others = "carriers' unit of length" if with_intrinsics else "carriers' unit of length or the focal lengths"
        return [Finding(Ground.NO_SIZE_FITS, f"{said} {words}; {why}{others}")]
    return [Finding(Ground.SIZE_ESTIMATED, f"the stated size of {words}; the poses use the size that the motion gives")]


def known_to_nothing(points: Iterable[PointUncertainty], rig: Rig) -> list[Finding]:
    """Findings about points whose uncertainty is a large share of their distance: stated values are wrong.

    No camera has so much noise. A possible cause is that the intrinsics of all cameras are wrong.
    """
    findings = []
    for point in points:
        distance_mm = 1e3 * float(np.linalg.norm(point.point_m))
        if np.isfinite(point.radius_mm) and point.radius_mm > LARGEST_SHARE * distance_mm:
            place = rig.source.place(("sensors", point.frame, "intrinsics"))
            words = (
                f"a point {1e-3 * distance_mm:.2f} m from {point.frame} is known to {point.radius_mm:.0f} mm only, and "
                "that is no noise of a camera: the carriers' poses (a path that drifts), intrinsics "
                f"({place}) and sizes do not fit together"
            )
            findings.append(Finding(Ground.KNOWN_TO_NOTHING, words))
    return findings


#: An image is upside down if its pose is half a turn about the optical axis from the expected one, within this angle.
#: It is not exact: the principal point is not the middle of the image, so the turned target is some pixels off.
NEAR_RAD = float(np.radians(6.0))
#: At most this number of images is named.
MOST_NAMED = 5


def turned_images(
    pairs: Mapping[Pair, MeasuredPairs], refined: Refined, rig: Rig, names: Mapping[str, str]
) -> list[Finding]:
    """A finding for each sensor with images that are upside down: left out, but right after half a turn.

    An image viewer that rotates and saves, or a camera that rotates images by gravity, turns single images. Their poses
    are then turned by 180 degrees about the optical axis. No wrong corner and no wrong arm pose does this. `names` are
    those of the images' files, as `image_names` returns them.
    """
    stamps: dict[str, set[int]] = defaultdict(set)
    of_all: dict[str, set[int]] = defaultdict(set)
    for pair, one in pairs.items():
        X, Y = refined.X.get(pair.target), refined.Y.get(pair.sensor)
        if X is None or Y is None or rig.sensors[pair.sensor].images is None:
            continue
        of_all[pair.sensor].update(one.stamps_ns.tolist())
        expected = inverse(Y.matrix()[None]) @ one.A @ X.matrix()
        error = one.B[:, :3, :3] @ expected[:, :3, :3].transpose(0, 2, 1)
        beside_half_a_turn = np.linalg.norm(so3_logmap(error @ np.diag([-1.0, -1.0, 1.0])), axis=1)
        is_turned = (beside_half_a_turn < NEAR_RAD) & ~one.used
        stamps[pair.sensor].update(one.stamps_ns[is_turned].tolist())
    findings = []
    for sensor, found in stamps.items():
        if not found:
            continue
        named = [image_name(names, str(rig.sensors[sensor].images), stamp) for stamp in sorted(found)]
        words = (
            f"{len(found)} of the {len(of_all[sensor])} images of {sensor} in which a target is read "
            f"{'is' if len(found) == 1 else 'are'} upside down and not used: {some(named, MOST_NAMED)}"
        )
        findings.append(Finding(Ground.IMAGE_TURNED, words))
    return findings
