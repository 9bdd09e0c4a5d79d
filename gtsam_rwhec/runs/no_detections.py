"""The message for a log in which no target was detected: what is likely, how much was searched, what was rejected."""

from __future__ import annotations

from gtsam_rwhec.logs import Log
from gtsam_rwhec.results.log_history import DetectionReport
from gtsam_rwhec.runs.log_contract import RECORDED_LOG

#: A message names at most this many tags that belong to no target.
MOST_NAMED = 20


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
    some = [f"{name} ({count} times)" for name, count in list(tags.items())[:MOST_NAMED]]
    return ", ".join(some) + (f" and {len(tags) - MOST_NAMED} others" if len(tags) > MOST_NAMED else "")
