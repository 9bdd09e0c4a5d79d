"""``gtsam-rwhec detect``: the first stage of a log's calibration."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

import gtsam_rwhec as rw
from gtsam_rwhec.cli.exit_status import ExitStatus
from gtsam_rwhec.cli.options import ImagesOption, LogArgument, McapOption, WorkersOption
from gtsam_rwhec.cli.stage_display import StageDisplay
from gtsam_rwhec.files.terminal_text import say, shown_path


def detect(
    log: LogArgument,
    rig: Annotated[Path, typer.Option(help="Rig file (YAML).")],
    output: McapOption,
    images: ImagesOption = False,
    draw: Annotated[Path | None, typer.Option(help="Folder for pictures: each image with its detections.")] = None,
    workers: WorkersOption = None,
) -> ExitStatus:
    """First stage: find the targets in the images and compute their poses."""
    with StageDisplay() as stage:
        sources = rw.rig.read_rig(rig)
        if draw is not None:
            rw.pipeline.check_drawable(sources, draw)
        report = rw.pipeline.detect_log(
            log, sources, output, images="copy" if images else "leave_out", workers=workers, progress=stage
        )
        used = sum(track.used for track in report.tracks)
        rejected = sum(track.seen for track in report.tracks) - used
        say(
            f"Written to {shown_path(output)}: {used} detections to use, and {rejected} rejected ones with the reasons."
        )
        if draw is not None:
            say(f"Written to {shown_path(draw)}: {rw.pipeline.draw_log(log, output, draw, progress=stage)} pictures.")
        say(f"Next: gtsam-rwhec clean {shown_path(output)} -o cleaned.mcap")
    return ExitStatus.DONE
