"""``gtsam-rwhec export``: the last stage of a log's calibration."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

import gtsam_rwhec as rw
from gtsam_rwhec.cli.exit_status import ExitStatus, exit_status
from gtsam_rwhec.cli.options import AnywayOption, exported
from gtsam_rwhec.cli.stage_display import StageDisplay
from gtsam_rwhec.files.terminal_text import say, shown_path


def export(
    solved: Annotated[Path, typer.Argument(help="The clean.mcap that solve or calibrate wrote.")],
    output: Annotated[Path, typer.Option("--output", "-o", help="Folder to write to.")],
    anyway: AnywayOption = False,
) -> ExitStatus:
    """Last stage: write a launch file, tf, URDF, cameras (Kalibr, ROS, OpenCV, COLMAP) and plots from a solved log."""
    if rw.runs.is_of_odometries(None, solved):
        with StageDisplay() as stage:
            for path in rw.runs.export_odometries(solved, output, anyway=anyway, progress=stage):
                say(shown_path(path))
        return _said(rw.runs.read_odometries(solved), anyway=anyway)
    with StageDisplay() as stage:
        for path in rw.runs.export_solved(solved, output, anyway=anyway, progress=stage):
            say(shown_path(path))
    return _said(rw.runs.read_solved(solved), anyway=anyway)


def _said(found: rw.runs.Solved | rw.runs.OdometrySolved, *, anyway: bool) -> ExitStatus:
    if found.judgement.verdict is not rw.Verdict.USE:
        say(str(found.judgement), to_errors=True)
    for message in exported(found, anyway=anyway):
        say(message, to_errors=True)
    return exit_status(found.judgement, of_rig=True)
