"""``gtsam-rwhec init``: a first rig file."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

import gtsam_rwhec as rw
from gtsam_rwhec.cli.exit_status import ExitStatus
from gtsam_rwhec.cli.options import LogArgument
from gtsam_rwhec.cli.stage_display import StageDisplay
from gtsam_rwhec.errors import FileFormatError
from gtsam_rwhec.files.atomic_write import write_atomically
from gtsam_rwhec.files.terminal_text import printable


def init(
    log: LogArgument,
    output: Annotated[Path, typer.Option("--output", "-o", help="Rig file to write.")] = Path("rig.yaml"),
) -> ExitStatus:
    """Look at a log and write a first rig file. What a person must fill in is marked."""
    if output.exists():
        raise FileFormatError(f"{output} is there already; it may have been filled in by hand. Give another name.")
    with StageDisplay() as stage:
        stage(f"looking at {log}")
        with rw.logs.open_log(log) as opened:
            text, notes = rw.first_rig.propose_rig(opened, output)
    write_atomically(output, text.encode())
    for note in notes:
        typer.echo(printable(note))
    typer.echo(f"Written to {output}. Fill in what is marked, then: gtsam-rwhec calibrate {log} --rig {output} -o out")
    return ExitStatus.DONE
