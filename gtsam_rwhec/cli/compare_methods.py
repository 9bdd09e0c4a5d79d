"""``gtsam-rwhec compare``: compare published methods on one set of measurements."""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import Annotated

import typer

import gtsam_rwhec as rw
from gtsam_rwhec.cli.failures import ExitStatus, check_output, exit_status
from gtsam_rwhec.cli.shared_options import (
    FOLDER_OF_CSV,
    KappaOption,
    ScaleOption,
    SensorsOption,
    SigmaOption,
    TargetsOption,
)
from gtsam_rwhec.cli.stage_display import StageDisplay
from gtsam_rwhec.files.terminal_text import say, shown_path


def _names_of_methods(beginning: str) -> list[str]:
    return [name for name in rw.methods.METHODS if name.startswith(beginning)]


def compare(
    folder: Annotated[Path, typer.Argument(help=f"A {FOLDER_OF_CSV}.")],
    scale: ScaleOption = "known",
    sigma: SigmaOption = None,
    kappa: KappaOption = None,
    method: Annotated[
        list[str] | None,
        typer.Option(
            help="Name of a method; repeat the option for several methods.",
            show_default="all",
            autocompletion=_names_of_methods,
        ),
    ] = None,
    targets: TargetsOption = "tag",
    sensors: SensorsOption = "cam",
    seed: Annotated[int, typer.Option(help="Seed for methods that draw random numbers.")] = 0,
    output: Annotated[Path | None, typer.Option("--output", "-o", help="File for all results (JSON).")] = None,
) -> ExitStatus:
    """Solve with every published method that applies; print the cost, gap, residuals and time of each.

    Methods for one target and one sensor run on each pair of the best tree, as people do by hand.
    """
    check_output(output)
    with StageDisplay() as stage, warnings.catch_warnings():
        stage(f"reading {folder}")
        problem = rw.read_csv(folder, scale, sigma, kappa, targets, sensors)
        warnings.simplefilter("ignore", rw.errors.RwhecWarning)  # the report has the methods' notes
        comparison = rw.methods.compare(
            problem,
            rw.methods.MethodOptions(seed=seed),
            methods=method,
            progress=lambda name: stage(f"solving by {name}"),
        )
    try:
        if output is not None:
            rw.methods.write_comparison(comparison, output)
            say(f"Written to {shown_path(output)}.", to_errors=True)
    finally:
        rw.methods.print_comparison(comparison)
    return ExitStatus.NOT_CERTIFIED if comparison.solution is None else exit_status(rw.judge(comparison.solution))
