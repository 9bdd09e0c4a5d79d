"""``gtsam-rwhec export``: the last stage of a log's calibration."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

import gtsam_rwhec as rw
from gtsam_rwhec.cli.exit_status import ExitStatus, exit_status
from gtsam_rwhec.cli.stage_display import StageDisplay
from gtsam_rwhec.files.terminal_text import say, shown_path


def export(
    solved: Annotated[Path, typer.Argument(help="The clean.mcap that solve or calibrate wrote.")],
    output: Annotated[Path, typer.Option("--output", "-o", help="Folder to write to.")],
) -> ExitStatus:
    """Last stage: write a launch file, tf, URDF, a Kalibr camchain and plots from a solved log."""
    with StageDisplay() as stage:
        for path in rw.pipeline.export_solved(solved, output, progress=stage):
            say(shown_path(path))
    judgement = rw.pipeline.read_solved(solved).judgement
    if judgement.verdict is rw.Verdict.DO_NOT_USE:
        say(f"No files for other programs were written. {judgement}", to_errors=True)
    return exit_status(judgement)
