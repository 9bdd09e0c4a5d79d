"""``gtsam-rwhec detect``: the first stage of a log's calibration."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

import gtsam_rwhec as rw
from gtsam_rwhec.cli.exit_status import ExitStatus
from gtsam_rwhec.cli.options import ImagesOption, LogArgument, McapOption, WorkersOption
from gtsam_rwhec.cli.stage_display import StageDisplay


def detect(
    log: LogArgument,
    rig: Annotated[Path, typer.Option(help="Rig file (YAML).")],
    output: McapOption,
    images: ImagesOption = False,
    draw: Annotated[
        Path | None, typer.Option(help="Folder for pictures: each image with what was detected in it.")
    ] = None,
    workers: WorkersOption = None,
) -> ExitStatus:
    """First stage: from images to poses of targets."""
    with StageDisplay() as stage:
        report = rw.pipeline.detect_log(
            log, rw.rig.read_rig(rig), output, images="copy" if images else "leave_out", workers=workers, progress=stage
        )
        used = sum(track.used for track in report.tracks)
        removed = sum(sum(track.removed.values()) for track in report.tracks)
        typer.echo(f"{used} detections to use, {removed} rejected, each with its reason, in {output}.")
        if draw is not None:
            typer.echo(f"{rw.pipeline.draw_log(log, output, draw, progress=stage)} images drawn in {draw}.")
    return ExitStatus.DONE
