"""The subcommand ``compare``: published methods side by side on one set of measurements."""

from __future__ import annotations

import warnings
from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from gtsam_rwhec.cli.exit_status import HELP, ExitStatus, exit_status
from gtsam_rwhec.cli.failures import failures_in_words
from gtsam_rwhec.cli.stage_display import StageDisplay
from gtsam_rwhec.errors import FileFormatError, RwhecWarning
from gtsam_rwhec.problem.csv_folder import read_csv


class CompareScale(StrEnum):
    """What is known about the scale of the measured translations."""

    known = "known"
    shared = "shared"
    per_target = "per_target"


def add_compare_command(app: typer.Typer) -> None:
    """Register it."""
    app.command(epilog=HELP)(compare)


def compare(
    folder: Annotated[Path, typer.Argument(help="Folder of <targets>_<id>_<sensors>_<id>_{A,B}.csv files.")],
    scale: Annotated[
        CompareScale, typer.Option(help="Is the targets' size known, wrong by one factor, or by one each?")
    ] = CompareScale.known,
    sigma: Annotated[
        float | None, typer.Option(help="Standard deviation of a measured translation along each axis, m.")
    ] = None,
    kappa: Annotated[
        float | None,
        typer.Option(help="Concentration of a measured rotation: 1/(2 s^2) for a deviation of s rad about each axis."),
    ] = None,
    method: Annotated[
        list[str] | None, typer.Option(help="A method to compare; may be given several times.", show_default="all")
    ] = None,
    targets: Annotated[str, typer.Option(help="The file names' word for targets.")] = "tag",
    sensors: Annotated[str, typer.Option(help="The file names' word for sensors.")] = "cam",
    seed: Annotated[int, typer.Option(help="Of the methods that draw at random.")] = 0,
    output: Annotated[Path | None, typer.Option("--output", "-o", help="Everything as JSON.")] = None,
) -> None:
    """Solve by every published method that applies; print cost, residuals, time and the gap to the certified bound."""
    # Methods bring in more of SciPy than a calibration needs.
    from gtsam_rwhec.methods.comparison import compare as compare_methods
    from gtsam_rwhec.methods.comparison_file import write_comparison
    from gtsam_rwhec.methods.method import MethodOptions
    from gtsam_rwhec.report.comparison_report import print_comparison

    with failures_in_words():
        if output is not None and not output.absolute().parent.is_dir():
            raise FileFormatError(f"{output} cannot be written: there is no folder {output.parent}.")
        with StageDisplay() as stage, warnings.catch_warnings():
            stage(f"reading {folder}")
            problem = read_csv(folder, scale.value, sigma, kappa, targets, sensors)
            warnings.simplefilter("ignore", RwhecWarning)  # the methods' own words are in the report
            comparison = compare_methods(
                problem, MethodOptions(seed=seed), methods=method, progress=lambda name: stage(f"solving by {name}")
            )
        try:
            if output is not None:
                write_comparison(comparison, output)
                typer.echo(f"Written to {output}.", err=True)
        finally:
            print_comparison(comparison)
        status = ExitStatus.NOT_CERTIFIED if comparison.solution is None else exit_status(comparison.solution)
        raise typer.Exit(status)
