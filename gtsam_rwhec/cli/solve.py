"""``gtsam-rwhec solve``: the third stage of a log's calibration."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

import gtsam_rwhec as rw
from gtsam_rwhec.cli.exit_status import ExitStatus
from gtsam_rwhec.cli.failures import said_in_the_report
from gtsam_rwhec.cli.options import RigOption, VerboseOption, show, show_odometries
from gtsam_rwhec.cli.stage_display import StageDisplay
from gtsam_rwhec.files.terminal_text import shown_path


def solve(
    cleaned: Annotated[Path, typer.Argument(help="The log that clean wrote.")],
    output: Annotated[Path, typer.Option("--output", "-o", help="Folder for result.json and clean.mcap.")],
    rig: RigOption = None,
    verbose: VerboseOption = False,
) -> ExitStatus:
    """Third stage: find the certified poses, refine them, and print covariances."""
    described = None if rig is None else rw.rig.read_rig(rig)
    if rw.runs.is_of_odometries(described, cleaned):
        with StageDisplay() as stage, said_in_the_report():
            solved = rw.runs.solve_odometries_into(cleaned, described, output, progress=stage)
        return show_odometries(solved, output, anyway=False, verbose=verbose)
    with StageDisplay() as stage, said_in_the_report():
        calibrated = rw.runs.solve_into(cleaned, described, output, progress=stage)
    messages = (
        f"Written: {shown_path(output / rw.runs.RESULT_FILE)}, {shown_path(output / rw.runs.CLEAN_LOG)}.",
        f"Next: gtsam-rwhec export {shown_path(output / rw.runs.CLEAN_LOG)} -o FOLDER",
    )
    return show(calibrated, messages, verbose=verbose)
