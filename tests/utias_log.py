"""The real dataset as a log: the rig's transform and one detection at each of 3230 stamps."""

from __future__ import annotations

from pathlib import Path

import gtsam_rwhec as rw
from gtsam_rwhec.logs import DetectionRecord, LogWriter

START_NS, STEP_NS = 1_700_000_000_000_000_000, 10_000_000
_SENSORS = "\n".join(f"  cam_{k}: {{detections: /cam_{k}/tags}}" for k in range(8))


def rig_text(targets: tuple[str, ...], rotation_deg: float, translation_mm: float) -> str:
    """A rig file of targets ``tag_ID``. Nothing is left out: every measurement counts, as from CSV."""
    tags = "\n".join(
        f"  {t}: {{type: tag, family: tag36h11, id: {t.removeprefix('tag_')}, size_m: 0.2}}" for t in targets
    )
    return f"""
carriers: {{sensors: rig, targets: world, poses: {{tf: [rig, world]}}}}
sensors:
{_SENSORS}
targets:
{tags}
sizes: known
noise: {{rotation_deg: {rotation_deg!r}, translation_mm: {translation_mm!r}}}
cleaning: {{consensus: false, thin: false, robust: none}}
"""


def write_utias_log(folder: Path, path: Path) -> None:
    """Write the CSV files' poses, one stamp for each measurement."""
    problem = rw.read_csv(folder)
    number = 0
    with LogWriter(path) as out:
        for target, sensor in problem.pairs:
            measured = problem.measurements(target, sensor)
            for A, B in zip(measured.A, measured.B, strict=True):
                stamp = START_NS + number * STEP_NS
                number += 1
                out.transforms("/tf", stamp, [("rig", "world", A)])
                tag = DetectionRecord(
                    stamp, stamp, f"/{sensor}/tags", sensor, "tag36h11", target.removeprefix("tag_"), T_camera_tag=B
                )
                out.detections(tag.topic, stamp, sensor, [tag])
