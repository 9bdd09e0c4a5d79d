"""``gtsam-rwhec calibrate``: calibrate from a log, or from a folder of CSV files."""

from __future__ import annotations

import math
from functools import partial
from pathlib import Path
from typing import Annotated, Literal

import typer

import gtsam_rwhec as rw
from gtsam_rwhec.cli.exit_status import ExitStatus, exit_status
from gtsam_rwhec.cli.failures import check_folder_of, said_in_the_report
from gtsam_rwhec.cli.options import (
    CSV_PANEL,
    FOLDER_OF_CSV,
    REFINEMENT_PANEL,
    ImagesOption,
    KappaOption,
    RigOption,
    ScaleOption,
    SensorsOption,
    SigmaOption,
    TargetsOption,
    WorkersOption,
    show,
)
from gtsam_rwhec.cli.roads import refuse
from gtsam_rwhec.cli.stage_display import StageDisplay
from gtsam_rwhec.files.terminal_text import say, shown_path

Method = Literal["auto", "sdp", "local"]
Refine = Literal["given", "estimate"]
Robust = Literal["none", "gnc", "huber", "cauchy", "tukey", "geman_mcclure"]

#: Parameters that count for a log; its rig file states the rest.
OF_LOG = frozenset({"source", "rig", "images", "workers", "output"})
#: Parameters that count for a folder of CSV files.
OF_FOLDER = frozenset({"source", "scale", "sigma", "kappa", "method", "initial", "targets", "sensors", "output"})
#: Parameters that count for the refinement.
OF_REFINEMENT = frozenset({"refine", "robust", "carrier_noise_deg", "carrier_noise_mm"})
# The options that each input refuses, by the reason and what to do.
NOT_FOR_A_LOG = {
    "not for a log. Its rig file states sizes, noise and names, and its calibration is always refined. Change the rig "
    "file, or leave the option out.": (OF_FOLDER | OF_REFINEMENT) - OF_LOG,
}
NOT_FOR_A_FOLDER = {"only for a log. A folder of CSV files has no images: leave the option out.": OF_LOG - OF_FOLDER}
NOT_WITHOUT_REFINEMENT = NOT_FOR_A_FOLDER | {
    "only with --refine. Add --refine given or --refine estimate, or leave the option out.": OF_REFINEMENT
}


def calibrate(
    context: typer.Context,
    source: Annotated[Path, typer.Argument(help=f"MCAP log, or {FOLDER_OF_CSV}.")],
    rig: RigOption = None,
    scale: ScaleOption = "known",
    sigma: SigmaOption = None,
    kappa: KappaOption = None,
    method: Annotated[
        Method,
        typer.Option(
            rich_help_panel=CSV_PANEL,
            help="auto: search, then the cheapest proof that succeeds. sdp: always solve the semidefinite relaxation. "
            "local: search from the answer in --initial only.",
        ),
    ] = "auto",
    targets: TargetsOption = "tag",
    sensors: SensorsOption = "cam",
    initial: Annotated[
        Path | None,
        typer.Option(
            rich_help_panel=CSV_PANEL, help="With --method local: result file (JSON) of an earlier calibration."
        ),
    ] = None,
    refine: Annotated[
        Refine | None,
        typer.Option(
            rich_help_panel=REFINEMENT_PANEL,
            help="Refine the certified answer and print covariances. given: with the noise in --sigma and --kappa. "
            "estimate: with the noise that the residuals show.",
        ),
    ] = None,
    robust: Annotated[
        Robust,
        typer.Option(
            rich_help_panel=REFINEMENT_PANEL,
            help="gnc: leave outliers out and certify the rest. The other words are robust losses.",
        ),
    ] = "none",
    carrier_noise_deg: Annotated[
        float | None,
        typer.Option(
            rich_help_panel=REFINEMENT_PANEL,
            help="Standard deviation of the carriers' poses A about each axis, degrees.",
        ),
    ] = None,
    carrier_noise_mm: Annotated[
        float | None,
        typer.Option(
            rich_help_panel=REFINEMENT_PANEL, help="Standard deviation of the carriers' poses A along each axis, mm."
        ),
    ] = None,
    images: ImagesOption = False,
    workers: WorkersOption = None,
    output: Annotated[
        Path | None,
        typer.Option("--output", "-o", help="For CSV files: result file (JSON). For a log: folder for all files."),
    ] = None,
) -> ExitStatus:
    """Calibrate from a log or from a folder of CSV files; print the verdict, what to do, the poses and the details.

    A log needs a rig file, which states the sizes of the targets. Its calibration writes clean.mcap, result.json,
    static_tf.launch.py, tf.yaml, rig.urdf.xacro, camchain.yaml and plots.
    """
    if rig is not None or is_log(source):
        refuse(context, NOT_FOR_A_LOG)
        if output is None:
            needed = "give -o FOLDER"
            if rig is None:
                needed += " and --rig FILE (a log that detect or clean wrote holds its own rig file)"
            raise typer.BadParameter(f"the calibration of a log writes several files: {needed}")
        return calibrate_log(source, rig, output, images=images, workers=workers)
    refuse(context, NOT_WITHOUT_REFINEMENT if refine is None else NOT_FOR_A_FOLDER)
    if (method == "local") != (initial is not None):
        raise typer.BadParameter("--method local and --initial FILE go together: give both, or neither")
    if (carrier_noise_deg is None) != (carrier_noise_mm is None):
        raise typer.BadParameter("--carrier-noise-deg and --carrier-noise-mm go together: give both, or neither")
    if refine == "given" and (sigma is None or kappa is None):
        raise typer.BadParameter("--refine given needs --sigma and --kappa: give both, or use --refine estimate")
    check_folder_of(output)
    with StageDisplay() as stage, said_in_the_report():
        stage(f"reading {source}")
        problem = rw.read_csv(source, scale, sigma, kappa, targets, sensors)
        earlier = None if initial is None else rw.read_solution(initial)
        start = None if earlier is None else (earlier.X, earlier.Y, earlier.scale)
        solution = rw.solve(problem, method=method, initial=start, progress=stage)
        refined = None
        if refine is not None:
            noise = None
            if carrier_noise_deg is not None and carrier_noise_mm is not None:
                noise = rw.CarrierNoise(math.radians(carrier_noise_deg), 1e-3 * carrier_noise_mm)
            how = rw.RefineOptions(noise=refine, robust=robust, carrier_noise=noise)
            refined = rw.refine(problem, solution, how, progress=stage)
            solution = refined.solution  # it is another solution if outliers were left out
    if refined is None:
        write, report = partial(rw.write_solution, solution), partial(rw.report.print_solution, solution)
    else:
        write, report = partial(rw.write_refined, refined), partial(rw.report.print_refined, refined)
    try:
        if output is not None:
            write(output)
            say(f"Written to {shown_path(output)}.", to_errors=True)
    finally:  # the report is printed even if the file cannot be written
        report()
    return exit_status(rw.judge(solution, refined))


def is_log(source: Path) -> bool:
    """Whether this is a log, and not a folder of CSV files."""
    return source.suffix.lower() == ".mcap" or (source.is_dir() and any(source.glob("*.mcap")))


def calibrate_log(source: Path, rig: Path | None, output: Path, *, images: bool, workers: int | None) -> ExitStatus:
    """Run all stages and print the report."""
    with StageDisplay() as stage, said_in_the_report():
        calibrated = rw.calibrate_log(
            source,
            None if rig is None else rw.rig.read_rig(rig),
            output,
            images="copy" if images else "leave_out",
            workers=workers,
            progress=stage,
        )
    status = show(calibrated)
    say(f"Written to {shown_path(output)}: {', '.join(rw.pipeline.OUTPUTS)}.", to_errors=True)
    return status
