"""Find why most detections of a target fail, from some of the images, and what to write in the rig file.

Each cause is tried on images (`detect.clues`) and reported with the number of images that show it. If no cause explains
the failure, the message says so.
"""

from __future__ import annotations

import time
from collections import Counter, defaultdict
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress

import numpy as np

from gtsam_rwhec.cameras.camera import Camera
from gtsam_rwhec.cameras.targets import FAMILIES, Checkerboard, CircleGrid, Target, is_same_print
from gtsam_rwhec.detect.clues import About, Clue, clues, edge_blur_px, motion_blur_px
from gtsam_rwhec.detect.detections import Rejection
from gtsam_rwhec.detect.detector import shortest_side_px
from gtsam_rwhec.detect.images import Gray, decode_gray
from gtsam_rwhec.errors import ImageError
from gtsam_rwhec.files.terminal_text import some
from gtsam_rwhec.logs import DetectionRecord, Log
from gtsam_rwhec.results.log_history import DetectionReport
from gtsam_rwhec.rig import Rig
from gtsam_rwhec.runs.run_log import RECORDED_LOG
from gtsam_rwhec.runs.sensor_detections import SensorDetections, images_at, spread

#: At most this number of images is looked at, of several targets at least `LEAST` for each; nothing more is tried after
#: this number of seconds of the processor.
MOST, LEAST, SECONDS = 12, 4, 5.0
#: At most this number of targets is looked for, and at most this number of others is named.
MOST_TARGETS, MOST_NAMED = 4, 10
#: A cause is named if at least this share of the images shows it, and at least two, where there are three or more.
SHARE = 0.25


def likely_causes(
    log: Log, rig: Rig, cameras: Mapping[str, Camera], found: Mapping[str, SensorDetections]
) -> tuple[str, ...]:
    """A sentence or two for each target of which most detections were rejected, or that was not seen at all."""
    sensors = [sensor for sensor, of_sensor in found.items() if of_sensor.images]
    doubted = [target for target in rig.target_list if _is_doubted(target, found)]
    if not sensors or not doubted:
        return ()
    images = {
        sensor: _some_images(log, str(rig.sensors[sensor].images), cameras[sensor], found[sensor], MOST // len(sensors))
        for sensor in sensors
    }
    said: list[str] = []
    unexplained: list[Target] = []
    is_any_used = any(not record.reason for of_sensor in found.values() for record in of_sensor.records)
    examined = doubted[:MOST_TARGETS]
    for target in examined:
        causes = list(of_rejections(rig, target, found, images))
        if not causes:
            most, seconds = max(LEAST, MOST // len(examined)), SECONDS / len(examined)
            causes = _of_clues(rig, target, _look(rig, target, cameras, found, images, most, seconds))
            if not causes and (not is_any_used or _records_of(target, found)):
                unexplained.append(target)  # else it may not be in the images: it is among those that no sensor saw
        said += causes
    if unexplained:
        said.append(nothing_explains(unexplained, found))
    if len(doubted) > MOST_TARGETS:
        others = [target.name for target in doubted[MOST_TARGETS : MOST_TARGETS + MOST_NAMED]]
        said.append(f"{len(doubted) - MOST_TARGETS} other targets are as badly seen ({', '.join(others)})")
    return tuple(cause if cause.endswith("?") else f"{cause}." for cause in said)


def _records_of(target: Target, found: Mapping[str, SensorDetections]) -> list[DetectionRecord]:
    return [record for of_sensor in found.values() for record in of_sensor.records if record.id == target.name]


def _is_doubted(target: Target, found: Mapping[str, SensorDetections]) -> bool:
    """Whether more of a target's detections were rejected than not, or there are none."""
    reasons = [record.reason for record in _records_of(target, found)]
    return 2 * sum(not reason for reason in reasons) < len(reasons) or not reasons


def _some_images(log: Log, topic: str, camera: Camera, of_sensor: SensorDetections, most: int) -> dict[int, Gray]:
    """Images by stamp: those with rejected detections first, then those without any, each spread over time."""
    rejected = {record.stamp_ns for record in of_sensor.records if record.reason}
    used = {record.stamp_ns for record in of_sensor.records if not record.reason}
    whole = _whole(of_sensor)
    chosen = spread([stamp for stamp in whole if stamp in rejected - used], max(most, 2))
    chosen += spread([stamp for stamp in whole if stamp not in rejected | used], max(most, 2) - len(chosen))
    return _decoded(log, topic, camera, of_sensor, chosen)


def _whole(of_sensor: SensorDetections) -> list[int]:
    """The stamps of images that could be used, in order of time."""
    return [stamp for stamp, image in sorted(of_sensor.images.items()) if not image.fault]


def _decoded(
    log: Log, topic: str, camera: Camera, of_sensor: SensorDetections, stamps: Sequence[int]
) -> dict[int, Gray]:
    """The images of some stamps, in their order, that can be decoded."""
    images = {}
    for record in images_at(log, topic, of_sensor, stamps):
        with suppress(ImageError):  # its fault is in the report
            images[record.stamp_ns] = decode_gray(record, (camera.width, camera.height))
    return {stamp: images[stamp] for stamp in stamps if stamp in images}


def _look(
    rig: Rig,
    target: Target,
    cameras: Mapping[str, Camera],
    found: Mapping[str, SensorDetections],
    images: Mapping[str, Mapping[int, Gray]],
    most: int,
    seconds: float,
) -> list[list[Clue]]:
    """The clues about a target in each image in which it was not read, one image of each sensor in turn."""
    until_s = time.thread_time() + seconds

    def is_late() -> bool:
        return time.thread_time() > until_s

    used = {
        (sensor, record.stamp_ns)
        for sensor, of_sensor in found.items()
        for record in of_sensor.records
        if record.id == target.name and not record.reason
    }
    others = {(t.family, i) for t in rig.target_list if t.name != target.name for i in t.ids}
    turns = [
        (place, sensor, gray)
        for sensor, of_sensor in images.items()
        for place, (stamp, gray) in enumerate(of_sensor.items())
        if (sensor, stamp) not in used
    ]
    of_image: list[list[Clue]] = []
    for _, sensor, gray in sorted(turns, key=lambda turn: turn[0])[:most]:
        if is_late():
            break
        seen = clues(gray, target, cameras[sensor], rig.detection_options, is_late)
        of_image.append([c for c in seen if c.about is not About.ID or (target.family, c.value) not in others])
    return of_image


def _of_clues(rig: Rig, target: Target, of_image: Sequence[Sequence[Clue]]) -> list[str]:
    """The causes that enough images show, the commonest first."""
    figures: dict[tuple[About, object], list[float]] = defaultdict(list)
    for clue in (clue for of_one in of_image for clue in set(of_one)):
        figures[clue.about, clue.value].append(clue.figure)
    enough = max(2 if len(of_image) > 2 else 1, SHARE * len(of_image))
    causes: dict[About, str] = {}  # of one thing, only the commonest value
    for (about, value), each in sorted(figures.items(), key=lambda item: -len(item[1])):
        if len(each) >= enough and about not in causes:
            of, figure = f"{len(each)} of {len(of_image)} images", float(np.median(each))
            causes[about] = f"{target.name}: {_sentence(rig, target, about, value, of, figure)}"
    return list(causes.values())


#: A reason for rejection counts as a cause if at least this share of a target's detections has it.
MOSTLY = 0.3
_SHARPER = "Focus the lens, stand still for each image, or expose for a shorter time"
#: What images show of a target that nothing else explains, and what to do.
_OF_IMAGES = {
    About.MARGIN: "in {of} it is read once the ground around it is made lighter: a tag needs a white margin around its "
    "black square, one module wide and more. Print it with one, or put white paper behind it",
    About.SMALL: "in {of} it is read only when the image is enlarged: its shortest side is about {figure:.0f} pixels "
    "long there. Go nearer, take a larger one, or images of more pixels",
    About.BLURRED: "in {of} it is read only when the image is made smaller: edges are blurred by about {figure:.1f} "
    f"pixels (standard deviation; sharp ones by less than 1). {_SHARPER}",
    About.DARK: "in {of} it is read only when the image is brightened: the brightest pixels have a gray value of about "
    "{figure:.0f} of 255. More light, or a longer exposure while the robot stands still",
    About.BRIGHT: "{of} are overexposed: {figure:.0%} of the pixels are saturated. Expose for a shorter time",
}


def _sentence(rig: Rig, target: Target, about: About, value: object, of: str, figure: float) -> str:
    """What images show, and what to do."""

    def write(key: str, text: object) -> str:
        return f"write {key}: {text} ({rig.source.place(('targets', target.name, key))})"

    match about:
        case About.COUNTS:
            assert isinstance(value, tuple)
            assert isinstance(target, (Checkerboard, CircleGrid))
            is_checkerboard, stated = isinstance(target, Checkerboard), (target.columns, target.rows)
            key, things = ("inner_corners", "inner corners") if is_checkerboard else ("circles", "circles")
            shown = f"{of} show a board of {value[0]} x {value[1]} {things}"
            if stated == value[::-1] and isinstance(target, CircleGrid) and target.larger_dot:
                return (
                    f"{shown}, or its larger dot at another corner than the {target.corner.replace('_', ' ')}: "
                    f"{write(key, list(value))}, or larger_dot: {_beside(target.corner)}"
                )
            why = ": columns and rows are exchanged" if stated == value[::-1] else ""
            if is_checkerboard and stated == (value[0] + 1, value[1] + 1):
                why = " (it counts squares; inner corners are where four squares meet)"
            return f"{shown}, and the rig file says {stated[0]} x {stated[1]}{why}: {write(key, list(value))}"
        case About.DOT:
            dot = f"with its larger dot at the {str(value).replace('_', ' ')}" if value else "without a larger dot"
            return f"{of} show the grid {dot}: {write('larger_dot', value or 'false')}"
        case About.FAMILY:
            family = _family_of(str(value), target)
            return f"{of} show tags of {family} and none of {target.family}: {write('family', family)}"
        case About.ID:
            return f"{of} show the tag {value} of {target.family}, and none shows {target.ids[0]}: {write('id', value)}"
        case About.BORDER:
            lines = "a single black border, which Kalibr's AprilGrids do not have" if value == 1 else "a double border"
            place = rig.source.place(("targets", target.name, "type"))
            return f"{of} show its tags with {lines}. Change the type of the target ({place})"
    return _OF_IMAGES[about].format(of=of, figure=figure)


def _beside(corner: str) -> str:
    """The corner to the right or to the left of a corner."""
    return corner.replace("left", "right") if "left" in corner else corner.replace("right", "left")


def _family_of(family: str, target: Target) -> str:
    """The smallest dictionary with the print of a family that has all of the target's ids."""
    same = [name for name in FAMILIES if is_same_print(name, family) and FAMILIES[name] > max(target.ids)]
    return min(same, key=lambda name: FAMILIES[name]) if same else family


def of_rejections(
    rig: Rig, target: Target, found: Mapping[str, SensorDetections], images: Mapping[str, Mapping[int, Gray]]
) -> Iterator[str]:
    """Causes from the reasons of rejected detections, with the measured values and the limits."""
    records = [(sensor, r) for sensor, of in found.items() for r in of.records if r.id == target.name]
    options, place = rig.detection_options, rig.source.place
    of_reason: dict[str, list[tuple[str, DetectionRecord]]] = defaultdict(list)
    for sensor, record in records:
        of_reason[record.reason.partition(":")[0]].append((sensor, record))
    for reason, those in of_reason.items():
        if len(those) < MOSTLY * len(records):
            continue
        said = f"{len(those)} of {len(records)} detections"
        sides = [shortest_side_px(target, r.corners_px) for _, r in those if r.corners_px is not None]
        off_px = [r.reprojection_px for _, r in those if r.reprojection_px is not None]
        match reason:
            case Rejection.SMALL if sides:
                what = (
                    f"{said} are small: a side of about {np.median(sides):.0f} pixels, and at least "
                    f"{options.min_side_px:g} are wanted. Go nearer, take a larger target, or images of more pixels; "
                    "or write detection: {min_side_px: ...}"
                )
            case Rejection.BLURRED:
                widths = [edge_blur_px(images[s][r.stamp_ns]) for s, r in those if r.stamp_ns in images.get(s, {})]
                much = f": the images' edges have a blur of about {np.median(widths):.1f} pixels" if widths else ""
                limit = f"at most {options.max_blur_px:g} (standard deviation) is wanted"
                what = f"{said} are blurred{much}, and {limit}. {_SHARPER}"
            case Rejection.REPROJECTION if off_px:
                places = "; ".join(place(("sensors", s, "intrinsics")) for s in dict.fromkeys(s for s, _ in those))
                what = (
                    f"in {said} the corners are {np.median(off_px):.1f} pixels off those of a plane that this camera "
                    f"sees. Are the intrinsics those of these images ({places}), and is the target flat?"
                )
            case Rejection.LAYOUT:
                ((words, _),) = Counter(r.reason for _, r in those).most_common(1)
                what = f"in {said} the {words} ({place(('targets', target.name))})"
            case Rejection.AMBIGUOUS:
                what = (
                    f"{said} are ambiguous: two of its poses look alike, and the motion does not tell which is right. "
                    "Turn the carriers further between images, about different axes; look at the target obliquely and "
                    "from nearer"
                )
            case _:
                continue
        yield f"{target.name}: {what}"


def nothing_explains(targets: Sequence[Target], found: Mapping[str, SensorDetections]) -> str:
    """The message if no tried cause explains why targets are not read."""
    names = [target.name for target in targets]
    tried = ["other families, ids and borders"] * any(target.ids for target in targets)
    tried += ["other numbers of columns and rows"] * any(not target.ids for target in targets)
    reasons = Counter(r.reason for of in found.values() for r in of.records if r.id in names and r.reason)
    counts = ", ".join(f"{count} {reason}" for reason, count in reasons.most_common())
    rejected = f" Rejected: {counts}." if reasons else ""
    them = "it" if len(targets) == 1 else "them"
    return (
        f"{', '.join(names)}: some images were searched for {them} with {' and '.join(tried)}, enlarged, brightened "
        f"and made smaller, and that did not help.{rejected} Does an image show {them}, whole and in focus?"
    )


#: A message names at most this many tags that belong to no target.
MOST_STRANGERS = 20


def no_detections(log: Log, report: DetectionReport) -> str:
    """The message: what is likely, how much was searched, why detections were rejected, which other tags there are."""
    looked_at = [f"{count} images or messages of {sensor}" for sensor, count in report.images.items()]
    said = [f"looked at {', '.join(looked_at)}"]
    said += [
        f"{len(faults)} of {sensor} not decoded, the first: {faults[0]}" for sensor, faults in report.undecoded.items()
    ]
    said += map(str, report.tracks)
    if report.strangers:
        said.append(f"tags that belong to no target were seen: {_named(report.strangers)}")
    else:
        said.append("no other tags of the targets' families were seen either")
    likely = "".join(f"\n- {cause}" for cause in report.likely)
    path = log.files[0].path
    where = path.name.removesuffix(RECORDED_LOG) if path.name.endswith(RECORDED_LOG) else str(path)  # or a folder
    return (
        f"{where}: no usable detection of a target of the rig file.{likely}\n{'; '.join(said)}. "
        "Are the families, ids and topics in the rig file right? (gtsam-rwhec init LOG names the tags that it finds)"
    )


def _named(tags: dict[str, int]) -> str:
    return some([f"{name} ({count} times)" for name, count in tags.items()], MOST_STRANGERS)


#: Motion blur may hide targets if at least this many images of a sensor, and this share of them, have no used target.
FEWEST, UNREAD = 3, 0.15
#: At most this many of these images are examined.
LOOKED_AT = 8
#: An image has motion blur if its edges across the motion have more than this blur in pixels, and more than this many
#: times the blur of edges along the motion. Sharp edges have less than 1 pixel.
WIDE_PX, WIDER = 1.6, 1.5
#: The same limit in pixels for images in which targets are read although they are blurred.
WIDE_AND_READ_PX = 2.2
#: A sensor is reported if at least this share of the examined images is blurred.
BLURRED_SHARE = 0.6


def blurred_images(
    log: Log, rig: Rig, cameras: Mapping[str, Camera], found: Mapping[str, SensorDetections]
) -> tuple[str, ...]:
    """A sentence, without a full stop, for each sensor of which many images are blurred by motion."""
    said = []
    for sensor, of_sensor in found.items():
        used = {record.stamp_ns for record in of_sensor.records if not record.reason}
        whole = _whole(of_sensor)
        unread = [stamp for stamp in whole if stamp not in used]
        hides = len(unread) >= max(FEWEST, UNREAD * of_sensor.count)
        looked_at = spread(unread if hides else whole, LOOKED_AT)
        if len(looked_at) < FEWEST:
            continue
        topic = str(rig.sensors[sensor].images)
        blur = list(map(motion_blur_px, _decoded(log, topic, cameras[sensor], of_sensor, looked_at).values()))
        least_px = WIDE_PX if hides else WIDE_AND_READ_PX
        moved = [(wide, narrow) for wide, narrow in blur if wide > least_px and wide > WIDER * narrow]
        if len(moved) >= max(2, BLURRED_SHARE * len(blur)):
            wide_px, narrow_px = np.median(moved, axis=0)
            what = (
                f"no target is read in {len(unread)} of {of_sensor.count} images of {sensor}, and motion blur hides "
                f"it: {len(moved)} of {len(blur)} of them that were looked at"
                if hides
                else f"motion blur is in {len(moved)} of {len(blur)} images of {sensor} that were looked at: they"
            )
            widths = f"{wide_px:.1f} pixels across the motion and {narrow_px:.1f} along it"
            said.append(f"{what} have edges with a blur of {widths}")
    return tuple(said)
