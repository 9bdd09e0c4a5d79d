"""``gtsam-rwhec calibrate``: from a log, or from a folder of CSV files."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Annotated, Literal

import typer

import gtsam_rwhec as rw
from gtsam_rwhec.cli.exit_status import ExitStatus, exit_status
from gtsam_rwhec.cli.failures import check_folder_of, said_in_the_report
from gtsam_rwhec.cli.log_result import show
from gtsam_rwhec.cli.options import (
    FOLDER_OF_CSV,
    ImagesOption,
    KappaOption,
    RigOption,
    Scale,
    ScaleOption,
    SensorsOption,
    SigmaOption,
    TargetsOption,
    WorkersOption,
)
from gtsam_rwhec.cli.roads import refuse
from gtsam_rwhec.cli.stage_display import StageDisplay

Method = Literal["auto", "sdp", "local"]
Refine = Literal["given", "estimate"]
Robust = Literal["none", "gnc", "huber", "cauchy", "tukey", "geman_mcclure"]


@dataclass(frozen=True)
class LogOptions:
    """What the calibration of a log takes from the command line; its rig file has the rest."""

    source: Path
    rig: Path | None
    images: bool
    workers: int | None
    output: Path


@dataclass(frozen=True)
class FolderOptions:
    """What the calibration of a folder of CSV files takes."""

    source: Path
    scale: Scale
    sigma: float | None
    kappa: float | None
    method: Method
    initial: Path | None
    targets: str
    sensors: str
    output: Path | None


@dataclass(frozen=True)
class RefinementOptions:
    """What the refinement takes."""

    refine: Refine
    robust: Robust
    carrier_noise_deg: float | None
    carrier_noise_mm: float | None

    @property
    def carrier_noise(self) -> rw.CarrierNoise | None:
        """Noise of the carriers' poses, where it is given."""
        if self.carrier_noise_deg is None or self.carrier_noise_mm is None:
            return None
        return rw.CarrierNoise(math.radians(self.carrier_noise_deg), 1e-3 * self.carrier_noise_mm)


OF_LOG, OF_FOLDER, OF_REFINEMENT = (
    frozenset(field.name for field in fields(record)) for record in (LogOptions, FolderOptions, RefinementOptions)
)
# What each way refuses: why, what to do, and the options.
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
            help="auto: search, then the cheapest proof that succeeds. sdp: always solve the semidefinite relaxation. "
            "local: search from --initial only."
        ),
    ] = "auto",
    targets: TargetsOption = "tag",
    sensors: SensorsOption = "cam",
    initial: Annotated[
        Path | None, typer.Option(help="For --method local: result of an earlier calibration (JSON) to start from.")
    ] = None,
    refine: Annotated[
        Refine | None,
        typer.Option(help="Refine the certified answer, with the given noise or an estimate; print covariances."),
    ] = None,
    robust: Annotated[
        Robust,
        typer.Option(help="With --refine: gnc leaves outliers out and certifies the rest; the others are losses."),
    ] = "none",
    carrier_noise_deg: Annotated[
        float | None, typer.Option(help="With --refine: noise of the carriers' poses A about each axis, degrees.")
    ] = None,
    carrier_noise_mm: Annotated[
        float | None, typer.Option(help="With --refine: noise of the carriers' poses A along each axis, mm.")
    ] = None,
    images: ImagesOption = False,
    workers: WorkersOption = None,
    output: Annotated[
        Path | None,
        typer.Option("--output", "-o", help="For CSV files: result file (JSON). For a log: folder for all files."),
    ] = None,
) -> ExitStatus:
    """Calibrate from a log or a folder of CSV files. Print poses, residuals, the certificate and covariances.

    For a log, the rig file states noise and sizes, and the files written to the folder are clean.mcap, result.json,
    static_tf.launch.py, tf.yaml, rig.urdf.xacro, camchain.yaml and plots.
    """
    if rig is not None or is_log(source):
        refuse(context, NOT_FOR_A_LOG)
        if output is None:
            raise typer.BadParameter("the calibration of a log is a folder of files: say which with -o FOLDER")
        return calibrate_log(LogOptions(source, rig, images, workers, output))
    refuse(context, NOT_WITHOUT_REFINEMENT if refine is None else NOT_FOR_A_FOLDER)
    if (method == "local") != (initial is not None):
        raise typer.BadParameter("--method local and --initial FILE go together: give both, or neither")
    if (carrier_noise_deg is None) != (carrier_noise_mm is None):
        raise typer.BadParameter("--carrier-noise-deg and --carrier-noise-mm go together: give both, or neither")
    return calibrate_folder(
        FolderOptions(source, scale, sigma, kappa, method, initial, targets, sensors, output),
        None if refine is None else RefinementOptions(refine, robust, carrier_noise_deg, carrier_noise_mm),
    )


def is_log(source: Path) -> bool:
    """Whether this is a log, and not a folder of CSV files."""
    return source.suffix.lower() == ".mcap" or (source.is_dir() and any(source.glob("*.mcap")))


def calibrate_log(options: LogOptions) -> ExitStatus:
    """Run all stages and print the report."""
    with StageDisplay() as stage, said_in_the_report():
        calibrated = rw.calibrate_log(
            options.source,
            None if options.rig is None else rw.rig.read_rig(options.rig),
            options.output,
            images="copy" if options.images else "leave_out",
            workers=options.workers,
            progress=stage,
        )
    status = show(calibrated)
    written = ", ".join(sorted(path.name for path in options.output.iterdir()))
    typer.echo(f"Written to {options.output}: {written}.", err=True)
    return status


def calibrate_folder(options: FolderOptions, refinement: RefinementOptions | None) -> ExitStatus:
    """Solve, refine where that is asked for, write the result and print the report."""
    check_folder_of(options.output)
    with StageDisplay() as stage, said_in_the_report():
        stage(f"reading {options.source}")
        problem = rw.read_csv(
            options.source,
            options.scale,
            options.sigma,
            options.kappa,
            options.targets,
            options.sensors,
            keep_measurements=refinement is not None,
        )
        initial = None
        if options.initial is not None:
            earlier = rw.read_solution(options.initial)
            initial = (earlier.X, earlier.Y, earlier.scale)
        solution = rw.solve(problem, method=options.method, initial=initial, progress=stage)
        refined = None
        if refinement is not None:
            how = rw.RefineOptions(
                noise=refinement.refine, robust=refinement.robust, carrier_noise=refinement.carrier_noise
            )
            refined = rw.refine(problem, solution, how, progress=stage)
            solution = refined.solution  # that of the inliers, where outliers were left out
    try:
        if options.output is not None:
            if refined is None:
                rw.write_solution(solution, options.output)
            else:
                rw.write_refined(refined, options.output)
            typer.echo(f"Written to {options.output}.", err=True)
    finally:  # a result that cannot be written is shown all the same
        if refined is None:
            rw.report.print_solution(solution)
        else:
            rw.report.print_refined(refined)
    return exit_status(rw.judge(solution, refined))
