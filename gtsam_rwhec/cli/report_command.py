"""``gtsam-rwhec report``: the report of a result as one HTML file."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

import gtsam_rwhec as rw
from gtsam_rwhec.cli.failures import ExitStatus, check_output
from gtsam_rwhec.cli.stage_display import StageDisplay
from gtsam_rwhec.files.terminal_text import say, shown_path


def report(
    result: Annotated[Path, typer.Argument(help="Output folder of a calibration, or its result file (JSON).")],
    output: Annotated[
        Path | None, typer.Option("--output", "-o", help="The HTML file.", show_default="report.html beside the result")
    ] = None,
    images: Annotated[
        bool, typer.Option("--images/--no-images", help="Whether the page shows images. They may be confidential.")
    ] = True,
    figures: Annotated[
        Path | None, typer.Option("--figures", help="Folder that gets every figure of the page as SVG and PNG too.")
    ] = None,
) -> ExitStatus:
    """Write the report of a finished calibration as one HTML file, which needs no network.

    ``calibrate`` writes it at its end; this command writes it again, or for results of other versions.
    """
    if output is None:
        output = report_path(result)
    check_output(output, *read_of(result))
    with StageDisplay() as stage:
        stage("writing the report")
        if rw.odometry.is_page_of_odometries(result):
            rw.odometry.write_odometry_page(result, output)
        else:
            rw.report.write_html(result, output, images=images, figures=figures)
    beside = "" if figures is None else f"; figures: {shown_path(figures)}"
    say(f"Written to {shown_path(output)}{beside}.", to_errors=True)
    return ExitStatus.DONE


def read_of(result: Path) -> tuple[Path, ...]:
    """The files that are read of a result, or of the folder that has it."""
    file = result / rw.runs.RESULT_FILE if result.is_dir() else result
    return file, rw.results.evidence_path(file)


def report_path(result: Path) -> Path:
    """Where the page of a result is: report.html in its folder or beside result.json, NAME.html beside NAME.json."""
    if result.is_dir():
        return result / rw.runs.REPORT_FILE
    if result.name == rw.runs.RESULT_FILE:
        return result.with_name(rw.runs.REPORT_FILE)
    return result.with_suffix(".html")
