"""``gtsam-rwhec clean``: the second stage of a log's calibration."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

import gtsam_rwhec as rw
from gtsam_rwhec.cli.exit_status import ExitStatus
from gtsam_rwhec.cli.options import McapOption, RigOption
from gtsam_rwhec.cli.stage_display import StageDisplay
from gtsam_rwhec.files.terminal_text import say, shown_path


def clean(
    detected: Annotated[Path, typer.Argument(help="The log that detect wrote.")],
    output: McapOption,
    rig: RigOption = None,
) -> ExitStatus:
    """Second stage: find the carriers' poses at each detection, and remove measurements that are not good enough."""
    with StageDisplay() as stage:
        report = rw.runs.clean_log(detected, output, None if rig is None else rw.rig.read_rig(rig), progress=stage)
        used = sum(track.used for track in report.tracks)
        say(
            f"Written to {shown_path(output)}: {used} measurements to use, and the removed measurements with the "
            "reasons."
        )
        say(f"Next: gtsam-rwhec solve {shown_path(output)} -o FOLDER")
    return ExitStatus.DONE
