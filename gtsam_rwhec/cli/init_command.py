"""``gtsam-rwhec init``: a first rig file."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import typer

import gtsam_rwhec as rw
from gtsam_rwhec.cli.failures import ExitStatus
from gtsam_rwhec.cli.stage_display import StageDisplay
from gtsam_rwhec.errors import FileFormatError
from gtsam_rwhec.files.terminal_text import say, shown_path
from gtsam_rwhec.files.whole_files import write_atomically

Template = Literal["eye-in-hand", "eye-to-hand", "rig", "several-cameras", "clouds", "odometry"]


def init(
    log: Annotated[
        Path | None,
        typer.Argument(
            help="MCAP file, a folder of MCAP files (a ROS 2 bag), or a folder of images or clouds with poses beside "
            "them.",
            show_default=False,
        ),
    ] = None,
    output: Annotated[Path, typer.Option("--output", "-o", help="Rig file to write.")] = Path("rig.yaml"),
    template: Annotated[
        Template | None,
        typer.Option(help="Write a whole rig file of a usual cell, with comments, in place of one made from a log."),
    ] = None,
    schema: Annotated[
        bool, typer.Option("--schema", help="Print the JSON Schema of rig files, for editors, and write nothing.")
    ] = False,
    reference: Annotated[
        bool, typer.Option("--reference", help="Print every key of rig files, as Markdown, and write nothing.")
    ] = False,
) -> ExitStatus:
    """Look at a log or a folder, and write a first rig file. TODO marks the lines that you must complete."""
    if schema + reference + (template is not None) + (log is not None) != 1:
        raise typer.BadParameter(
            "give one of: a log or a folder of images or clouds, --template, --schema, --reference"
        )
    if schema or reference:
        typer.echo(rw.rig.schema_text() if schema else rw.rig.reference_text(), nl=False)
        return ExitStatus.DONE
    if output.exists():
        raise FileFormatError(f"{output} exists already, perhaps with your changes. Give another name with -o.")
    with StageDisplay() as stage:
        text, notes = _first(log, template, output, stage)
    text = rw.rig.editor_line() + text
    write_atomically(output, text.encode())
    source = "LOG_OR_FOLDER" if log is None else shown_path(log)
    call = f" gtsam-rwhec calibrate {source} --rig {shown_path(output)} -o out"
    for note in notes:
        say(note)
    say(f"\nWritten to {shown_path(output)}.")
    lines = rw.rig.todo_lines(text)
    if lines:
        say("Complete these lines, and take the mark TODO away:")
        for line in lines:
            say(f"  {line}")
        say("Then:" + call)
    else:
        say("Next:" + call)
    return ExitStatus.DONE


def _first(
    log: Path | None, template: Template | None, output: Path, stage: StageDisplay
) -> tuple[str, tuple[str, ...]]:
    """The text of a first rig file, and what was seen."""
    if template is not None:
        return rw.rig.template_text(template), ()
    assert log is not None
    stage(f"looking at {log}")
    if rw.rig.is_folder_without_logs(log):
        return rw.rig.propose_folder_rig(log, output, progress=stage)
    with rw.logs.open_log(log) as opened:
        return rw.rig.propose_rig(opened, output)
