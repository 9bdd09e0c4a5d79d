"""When no target was detected in a way that can be used: what was seen in its place, for the message that says so."""

from __future__ import annotations

from collections import Counter

from gtsam_rwhec.errors import ImageError
from gtsam_rwhec.logs import ImageRecord, Log
from gtsam_rwhec.pipeline.image_detections import message_count
from gtsam_rwhec.results.stage_reports import DetectionReport
from gtsam_rwhec.rig import Rig
from gtsam_rwhec.vision.images import decode_gray
from gtsam_rwhec.vision.tag_survey import tags_in_image

#: Images of each camera in which tags of all families are looked for (a second each), evenly from all of them.
IMAGES = 3
#: Of the tags that are no target, so many are named.
MOST_NAMED = 20


def no_detections(log: Log, rig: Rig, report: DetectionReport) -> str:
    """The message: how much was looked at, why detections were rejected, which tags there are instead."""
    parts = [f"{count} images or messages of {sensor}" for sensor, count in report.images.items()]
    said = [f"looked at {', '.join(parts)}"]
    said += [
        f"{len(faults)} of {sensor} not decoded, the first: {faults[0]}" for sensor, faults in report.undecoded.items()
    ]
    said += map(str, report.tracks)
    if report.strangers:
        said.append(f"tags that are no target were seen: {_named(report.strangers)}")
    else:
        said.append("no other tags of the targets' families were seen either")
        if any(source.images is not None for source in rig.sensors.values()):
            others = other_families(log, rig)
            said.append(f"tags of other families, in a few of the images: {_named(others) if others else 'none'}")
    return (
        f"{log.files[0].path}: no target of the rig file was detected in a way that can be used. {'; '.join(said)}. "
        "Are the families, ids and topics in the rig file right? (gtsam-rwhec init LOG says which tags it finds)"
    )


def other_families(log: Log, rig: Rig) -> dict[str, int]:
    """Tags of any family in a few images: how many images each was in; those of a single one may be chance."""
    seen: Counter[str] = Counter()
    looked_at = 0
    topics = [source.images for source in rig.sensors.values() if source.images is not None]
    every = {topic: max(1, -(-message_count(log, topic) // IMAGES)) for topic in topics}
    passed: Counter[str] = Counter()
    for record in log.records(topics) if topics else ():
        if not isinstance(record, ImageRecord):
            continue
        passed[record.topic] += 1
        if (passed[record.topic] - 1) % every[record.topic]:
            continue
        try:
            gray = decode_gray(record)
        except ImageError:
            continue
        looked_at += 1
        seen.update({f"{tag.family} {tag.id}" for tag in tags_in_image(gray)})
    return {name: count for name, count in seen.most_common() if count > 1 or looked_at == 1}


def _named(tags: dict[str, int]) -> str:
    some = [f"{name} ({count} times)" for name, count in list(tags.items())[:MOST_NAMED]]
    return ", ".join(some) + (f" and {len(tags) - MOST_NAMED} others" if len(tags) > MOST_NAMED else "")
