"""The message for a log in which no target was detected: how much was searched, and which tags are there."""

from __future__ import annotations

from collections import Counter

from gtsam_rwhec.first_rig.log_contents import read_contents
from gtsam_rwhec.logs import Log
from gtsam_rwhec.results.log_history import DetectionReport
from gtsam_rwhec.rig import Rig

#: A message names at most this many tags that belong to no target.
MOST_NAMED = 20


def no_detections(log: Log, rig: Rig, report: DetectionReport) -> str:
    """The message: how much was searched, why detections were rejected, which other tags there are."""
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
        if any(source.images is not None for source in rig.sensors.values()):
            others = tags_of_any_family(log, rig)
            said.append(f"tags of other families, in a few of the images: {_named(others) if others else 'none'}")
    return (
        f"{log.files[0].path}: no usable detection of a target of the rig file. {'; '.join(said)}. "
        "Are the families, ids and topics in the rig file right? (gtsam-rwhec init LOG names the tags that it finds)"
    )


def tags_of_any_family(log: Log, rig: Rig) -> dict[str, int]:
    """Count in how many of some images each tag of any family was. A tag that only a single image has may be chance."""
    seen: Counter[str] = Counter()
    topics = {source.images for source in rig.sensors.values()}
    surveyed = [images for topic, images in read_contents(log).images.items() if topic in topics]
    for images in surveyed:
        for family, tags in images.tags.items():
            seen.update({f"{family} {number}": count for number, count in (tags.single + tags.double).items()})
    is_one_image = sum(images.looked_at for images in surveyed) == 1
    return {name: count for name, count in seen.most_common() if count > 1 or is_one_image}


def _named(tags: dict[str, int]) -> str:
    some = [f"{name} ({count} times)" for name, count in list(tags.items())[:MOST_NAMED]]
    return ", ".join(some) + (f" and {len(tags) - MOST_NAMED} others" if len(tags) > MOST_NAMED else "")
