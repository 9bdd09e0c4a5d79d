"""``gtsam-rwhec clean``: the second stage of a log's calibration."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

import gtsam_rwhec as rw
from gtsam_rwhec.cli.exit_status import ExitStatus
from gtsam_rwhec.cli.options import McapOption, RigOption
from gtsam_rwhec.cli.stage_display import StageDisplay


def clean(
    detected: Annotated[Path, typer.Argument(help="The log that detect wrote.")],
    output: McapOption,
    rig: RigOption = None,
) -> ExitStatus:
    """Second stage: synchronise with the carriers' poses, and take out what should not be used."""
    with StageDisplay() as stage:
        report = rw.pipeline.clean_log(detected, output, None if rig is None else rw.rig.read_rig(rig), progress=stage)
        used = sum(track.used for track in report.tracks)
        typer.echo(f"{used} measurements to use, the others with their reasons, in {output}.")
    return ExitStatus.DONE
