"""Why targets are not read, where most are not: what some of the images say, with what to write in the rig file.

Each cause was tried on images (`vision.clues`) and is named with how many of them show it. Where nothing that was tried
explains it, that is said.
"""

from __future__ import annotations

import time
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from gtsam_rwhec.cameras.camera import Camera
from gtsam_rwhec.cameras.targets import Target
from gtsam_rwhec.detect.clues import About, Clue, clues
from gtsam_rwhec.detect.images import Gray, decode_gray
from gtsam_rwhec.errors import ImageError
from gtsam_rwhec.logs import DetectionRecord, ImageRecord, Log
from gtsam_rwhec.rig import Rig
from gtsam_rwhec.runs.causes_in_words import nothing_explains, of_rejections, sentence
from gtsam_rwhec.runs.sensor_detections import SensorDetections

#: At most this number of images is looked at, of several targets at least `LEAST` for each; nothing more is tried after
#: this number of seconds of the processor.
MOST, LEAST, SECONDS = 12, 4, 5.0
#: At most this number of targets is looked for, and at most this number of others is named.
MOST_TARGETS, MOST_NAMED = 4, 10
#: A cause is named if at least this share of the images shows it, and at least two, where there are three or more.
SHARE = 0.25


@dataclass(frozen=True, eq=False)
class _Seen:
    """What some images say about a target: how many there were, and the clues of each."""

    looked_at: int
    of_image: Sequence[Sequence[Clue]]


def likely_causes(
    log: Log, rig: Rig, cameras: Mapping[str, Camera], found: Mapping[str, SensorDetections]
) -> tuple[str, ...]:
    """A sentence or two for each target of which most detections were rejected, or that was not seen at all."""
    sensors = [sensor for sensor, of_sensor in found.items() if of_sensor.images]
    doubted = [target for target in rig.target_list if _is_doubted(target, found)]
    if not sensors or not doubted:
        return ()
    until_s = time.thread_time() + SECONDS
    images = {
        sensor: _some_images(log, str(rig.sensors[sensor].images), cameras[sensor], found[sensor], MOST // len(sensors))
        for sensor in sensors
    }
    said: list[str] = []
    unexplained: list[Target] = []
    is_any_used = any(not record.reason for of_sensor in found.values() for record in of_sensor.records)
    examined = doubted[:MOST_TARGETS]
    for number, target in enumerate(examined):
        now_s = time.thread_time()
        ends_s = now_s + (until_s - now_s) / (len(examined) - number)
        causes = of_rejections(rig, target, found, images)
        if not causes:
            seen = _look(rig, target, cameras, found, images, max(LEAST, MOST // len(examined)), ends_s)
            causes = _of_clues(rig, target, seen)
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
    whole = [stamp for stamp, image in sorted(of_sensor.images.items()) if not image.fault]
    chosen: list[int] = []
    for members in ([s for s in whole if s in rejected - used], [s for s in whole if s not in rejected | used]):
        count = min(len(members), max(most, 2) - len(chosen))
        if count > 0:
            places = np.linspace(0, len(members) - 1, count + 2)[1:-1] if count < len(members) else np.arange(count)
            chosen += [members[i] for i in places.round().astype(int).tolist()]
    wanted = {stamp: of_sensor.images[stamp].logged_ns for stamp in chosen}
    images = {}
    for record in log.records_logged_at([topic], wanted.values()):
        if isinstance(record, ImageRecord) and record.stamp_ns in wanted:
            try:
                images[record.stamp_ns] = decode_gray(record, (camera.width, camera.height))
            except ImageError:
                continue  # its fault is in the report
    return {stamp: images[stamp] for stamp in chosen if stamp in images}


def _look(
    rig: Rig,
    target: Target,
    cameras: Mapping[str, Camera],
    found: Mapping[str, SensorDetections],
    images: Mapping[str, Mapping[int, Gray]],
    most: int,
    until_s: float,
) -> _Seen:
    """The clues about a target in the images in which it was not read, one of each sensor in turn."""

    def is_late() -> bool:
        return time.thread_time() > until_s

    used = {
        (sensor, record.stamp_ns)
        for sensor, of_sensor in found.items()
        for record in of_sensor.records
        if record.id == target.name and not record.reason
    }
    others = {(t.family, i) for t in rig.target_list if t.name != target.name for i in t.ids}
    of_image: list[list[Clue]] = []
    turns = [
        (place, sensor, gray)
        for sensor, of_sensor in images.items()
        for place, (stamp, gray) in enumerate(of_sensor.items())
        if (sensor, stamp) not in used
    ]
    for _, sensor, gray in sorted(turns, key=lambda turn: turn[0])[:most]:
        if is_late():
            break
        seen = clues(gray, target, cameras[sensor], rig.detection_options, is_late)
        of_image.append([c for c in seen if c.about is not About.ID or (target.family, c.value) not in others])
    return _Seen(len(of_image), of_image)


def _of_clues(rig: Rig, target: Target, seen: _Seen) -> list[str]:
    """The causes that enough images show, the commonest first."""
    figures: dict[tuple[About, object], list[float]] = defaultdict(list)
    for of_image in seen.of_image:
        for clue in set(of_image):
            figures[clue.about, clue.value].append(clue.figure)
    enough = max(2 if seen.looked_at > 2 else 1, SHARE * seen.looked_at)
    common = sorted((key for key in figures if len(figures[key]) >= enough), key=lambda key: -len(figures[key]))
    return [
        sentence(rig, target, about, value, figures[about, value], seen.looked_at)
        for number, (about, value) in enumerate(common)
        if about not in [before for before, _ in common[:number]]  # of one thing, only the commonest value
    ]
