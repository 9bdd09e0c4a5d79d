"""``gtsam-rwhec calibrate``: calibrate from a log, or from a folder of CSV files."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Annotated, Literal, TypeVar

import typer

import gtsam_rwhec as rw
from gtsam_rwhec.cli.failures import ExitStatus, check_output, exit_status, said_in_the_report
from gtsam_rwhec.cli.report_command import report_path
from gtsam_rwhec.cli.shared_options import (
    CHOICES_PANEL,
    CSV_PANEL,
    FOLDER_OF_CSV,
    LOG_PANEL,
    WHOLE,
    AnywayOption,
    ImagesOption,
    KappaOption,
    NoReportImagesOption,
    RigOption,
    ScaleOption,
    SensorsOption,
    SigmaOption,
    TargetsOption,
    VerboseOption,
    WorkersOption,
    command_of,
    exported,
    refuse,
    show,
    show_odometries,
    written_in,
)
from gtsam_rwhec.cli.stage_display import StageDisplay
from gtsam_rwhec.files.terminal_text import say, shown_path

Method = Literal["auto", "sdp", "local"]
Noise = Literal["auto", "given", "estimate"]
Robust = Literal["auto", "gnc", "none"]
Stated = TypeVar("Stated")

#: Parameters that count for a log; its rig file states the rest.
OF_LOG = frozenset({"source", "verbose", "rig", "images", "no_report_images", "workers", "anyway", "force", "output"})
#: Parameters that count for a folder of CSV files.
OF_FOLDER = frozenset(
    {"source", "verbose", "scale", "sigma", "kappa", "targets", "sensors", "certified_only", "output"}
)
#: Parameters that overrule a choice of ``rw.calibrate``.
OF_CHOICES = frozenset({"noise", "robust", "as_read", "repair"}) | frozenset(
    {"carrier_noise_deg", "carrier_noise_mm", "arm_accuracy_deg", "arm_accuracy_mm"}
)
#: Parameters of the certified solution alone.
OF_SOLVE = frozenset({"method", "initial"})
# The options that each input refuses, by the reason and what to do.
NOT_FOR_A_LOG = {
    "not for a log. Its rig file states sizes, noise and names, and its calibration is always refined. Change the rig "
    "file, or leave the option out.": (OF_FOLDER | OF_CHOICES | OF_SOLVE) - OF_LOG
}
NOT_FOR_ODOMETRIES = {
    "counts only for images, and every sensor of the rig file has odometry. Leave it out.": frozenset(
        {"images", "no_report_images", "workers"}
    )
}
NOT_FOR_A_FOLDER = {
    "only for a log. A folder of CSV files has no images, and its result is one file, which is replaced: leave the "
    "option out.": OF_LOG - OF_FOLDER
}
NOT_FOR_SAMPLES = {
    "not for samples of a hand-eye tool, which are of one camera and one target. Leave the option out.": frozenset(
        {"scale", "sigma", "kappa", "targets", "sensors"}
    )
}
NOT_WITH_ALL = NOT_FOR_A_FOLDER | {"only with --certified-only. Add it, or leave the option out.": OF_SOLVE}
NOT_CERTIFIED_ONLY = NOT_FOR_A_FOLDER | {
    "not with --certified-only, which neither looks for outliers nor refines. Leave one of them out.": OF_CHOICES
}


def calibrate(
    context: typer.Context,
    source: Annotated[
        Path,
        typer.Argument(
            help="MCAP log, folder of images (--rig) or clouds with poses beside them, samples of MoveIt, easy_handeye "
            f"or OpenCV (YAML, JSON, XML), or {FOLDER_OF_CSV}."
        ),
    ],
    rig: RigOption = None,
    scale: ScaleOption = "known",
    sigma: SigmaOption = None,
    kappa: KappaOption = None,
    targets: TargetsOption = "tag",
    sensors: SensorsOption = "cam",
    noise: Annotated[
        Noise,
        typer.Option(
            rich_help_panel=CHOICES_PANEL,
            help="The noise of B. auto, estimate: what the residuals show. given: --sigma and --kappa as they are.",
        ),
    ] = "auto",
    robust: Annotated[
        Robust,
        typer.Option(
            rich_help_panel=CHOICES_PANEL,
            help="auto, gnc: leave outliers out and certify the rest. none: every measurement counts.",
        ),
    ] = "auto",
    carrier_noise_deg: Annotated[
        float | None,
        typer.Option(
            rich_help_panel=CHOICES_PANEL, help="Standard deviation of the carriers' poses A about each axis, degrees."
        ),
    ] = None,
    carrier_noise_mm: Annotated[
        float | None,
        typer.Option(
            rich_help_panel=CHOICES_PANEL, help="Standard deviation of the carriers' poses A along each axis, mm."
        ),
    ] = None,
    arm_accuracy_deg: Annotated[
        float | None,
        typer.Option(
            rich_help_panel=CHOICES_PANEL,
            help="How far off an arm's poses are, alike at poses near each other: about each axis, degrees.",
        ),
    ] = None,
    arm_accuracy_mm: Annotated[
        float | None,
        typer.Option(rich_help_panel=CHOICES_PANEL, help="The same along each axis, mm: its absolute accuracy."),
    ] = None,
    as_read: Annotated[
        bool,
        typer.Option(
            "--as-read",
            rich_help_panel=CHOICES_PANEL,
            help="Do not try other readings of A and B. Residuals that no sensor has are still refused.",
        ),
    ] = False,
    repair: Annotated[
        bool,
        typer.Option(
            "--repair",
            rich_help_panel=CHOICES_PANEL,
            help="Where rows of A and B are shifted, all or from some row on (an image without a detection), shift "
            "them back; the verdict names them.",
        ),
    ] = False,
    certified_only: Annotated[
        bool,
        typer.Option(
            "--certified-only",
            rich_help_panel=CSV_PANEL,
            help="The certified solution of all measurements as they are: no search for outliers, no refinement.",
        ),
    ] = False,
    method: Annotated[
        Method,
        typer.Option(
            rich_help_panel=CSV_PANEL,
            help="With --certified-only. auto: search, then the cheapest proof that succeeds. sdp: always solve the "
            "semidefinite relaxation. local: search from the answer in --initial only.",
        ),
    ] = "auto",
    initial: Annotated[
        Path | None,
        typer.Option(
            rich_help_panel=CSV_PANEL, help="With --method local: result file (JSON) of an earlier calibration."
        ),
    ] = None,
    images: ImagesOption = False,
    no_report_images: NoReportImagesOption = False,
    workers: WorkersOption = None,
    anyway: AnywayOption = False,
    force: Annotated[
        bool,
        typer.Option(
            "--force",
            rich_help_panel=LOG_PANEL,
            help="Replace a finished calibration in the output folder, or an unfinished run of other inputs. Only "
            "files that a calibration wrote are replaced. An unfinished run of the same inputs is gone on with, "
            "without this option too.",
        ),
    ] = False,
    output: Annotated[
        Path | None,
        typer.Option("--output", "-o", help="For CSV files: result file (JSON). For a log: folder for all files."),
    ] = None,
    verbose: VerboseOption = False,
) -> ExitStatus:
    """Calibrate from a log or from a folder of CSV files; print the verdict, what to do, and the poses.

    A log needs a rig file, which states the sizes of the targets. Its calibration writes calibration.mcap, result.json,
    static_tf.launch.py, tf.yaml, rig.urdf.xacro, and the cameras for Kalibr, ROS, OpenCV and COLMAP.
    """
    is_of_clouds = rig is None and not is_log(source) and source.is_dir() and _has_clouds(source)
    if rig is not None or is_log(source) or is_of_clouds:
        refuse(context, NOT_FOR_A_LOG)
        described = None if rig is None else rw.rig.read_rig(rig)
        # Asking needs packages that take long to load.
        is_of_odometries = not is_of_clouds and rw.odometry.is_of_odometries(described, source)
        if is_of_odometries:
            refuse(context, NOT_FOR_ODOMETRIES)
        if output is None:
            needed = "give -o FOLDER"
            if rig is None and not is_of_clouds:
                needed += " and --rig FILE (a log that detect or clean wrote holds its own rig file)"
            raise typer.BadParameter(f"the calibration of a log writes several files: {needed}")
        if is_of_odometries:
            with StageDisplay() as stage, said_in_the_report():
                solved = rw.odometry.calibrate_odometry_log(
                    source, described, output, anyway=anyway, replace=force, progress=stage
                )
            return show_odometries(solved, output, anyway=anyway, verbose=verbose)
        return calibrate_log(
            source,
            rig,
            output,
            images=images,
            report_images=not no_report_images,
            workers=workers,
            anyway=anyway,
            force=force,
            verbose=verbose,
        )
    if (words := other_than_csv(source)) is not None:
        raise typer.BadParameter(words)
    refuse(context, NOT_CERTIFIED_ONLY if certified_only else NOT_WITH_ALL)
    is_samples = rw.logs.is_samples_file(source)
    if is_samples:
        refuse(context, NOT_FOR_SAMPLES)
    if (method == "local") != (initial is not None):
        raise typer.BadParameter("--method local and --initial FILE go together: give both, or neither")
    carriers = _stated(rw.CarrierNoise, "--carrier-noise", carrier_noise_deg, carrier_noise_mm)
    arm = _stated(rw.ArmAccuracy, "--arm-accuracy", arm_accuracy_deg, arm_accuracy_mm)
    if repair and as_read:
        raise typer.BadParameter("--repair shifts rows that were misread, which --as-read does not look for: give one")
    if noise == "given" and (sigma is None or kappa is None):
        raise typer.BadParameter("--noise given needs --sigma and --kappa: give both, or use --noise estimate")
    check_output(output, source)
    with StageDisplay() as stage, said_in_the_report():
        stage(f"reading {source}")
        if is_samples:
            of_samples = rw.runs.samples_problem(source)
            problem = of_samples.problem
            say(of_samples.said, to_errors=True)
        else:
            problem = rw.read_csv(source, scale, sigma, kappa, targets, sensors)
        write: Callable[[Path], None]
        if certified_only:
            earlier = None if initial is None else rw.read_solution(initial)
            start = None if earlier is None else (earlier.X, earlier.Y, earlier.scale)
            solution = rw.solve(problem, method=method, initial=start, progress=stage)
            # Residuals of an answer that is not the optimum tell nothing of the reading.
            is_optimal = solution.certificate.is_optimal
            of_reading = rw.reading_of(problem, solution, stage).finding if is_optimal else None
            findings = () if of_reading is None else (of_reading,)
            write = partial(rw.write_solution, solution)
            evidence = None
            report = partial(rw.report.print_solution, solution, findings=findings)
            judgement = rw.judge(solution, findings=findings)
        else:
            options = rw.CalibrateOptions(
                noise=noise, robust=robust, carrier_noise=carriers, systematic=arm or True,
                misreadings=not as_read, repair=repair,
            )  # fmt: skip
            calibration = rw.calibrate(problem, options, progress=stage)
            if repair and rw.Ground.ROWS_REPAIRED not in calibration.judgement.grounds:
                say("--repair: no rows slipped, and every row is as it was.", to_errors=True)
            write = partial(rw.write_calibration, calibration)
            evidence = None if output is None else partial(_evidence, source, problem, calibration, command_of(context))
            report = partial(rw.report.print_calibration, calibration)
            judgement = calibration.judgement
    written, page = [], None
    try:
        if output is not None:
            write(output)
            page = _write_report(output, None if evidence is None else evidence())
            beside = "" if page is None else f"; report: {shown_path(page)}"
            written.append(f"Written to {shown_path(output)}{beside}.")
            say(written[0], to_errors=True)
    finally:  # the report is printed even if the file cannot be written
        report(verbose=verbose, lines=rw.report.lines_beside(written), page=page, whole=WHOLE)
    return exit_status(judgement)


def _stated(of: Callable[[float, float], Stated], option: str, deg: float | None, mm: float | None) -> Stated | None:
    """What two options state of the carriers' poses; None where neither is given."""
    if (deg is None) != (mm is None):
        raise typer.BadParameter(f"{option}-deg and {option}-mm go together: give both, or neither")
    return None if deg is None or mm is None else of(math.radians(deg), 1e-3 * mm)


def _evidence(source: Path, problem: rw.Problem, calibration: rw.Calibration, command: str) -> rw.results.Evidence:
    """What the report shows beside the calibration of a folder of CSV files, or of a file of samples."""
    read = sorted(source.glob("*.csv")) if source.is_dir() else [source]
    inputs = rw.results.Inputs(files=rw.results.input_files(read), versions=rw.results.versions(), command=command)
    return rw.results.evidence_of(problem, calibration, inputs)


def _write_report(output: Path, evidence: rw.results.Evidence | None) -> Path | None:
    """Write the page of a result beside it, and its evidence; the page's path."""
    if output.suffix != ".json":
        return None  # a device, or a name that somebody chose for a reason: nothing is written beside it
    if evidence is not None:
        rw.results.write_evidence(evidence, rw.results.evidence_path(output), output)
    page = report_path(output)
    rw.report.write_html(output, page)
    return page


def _has_clouds(folder: Path) -> bool:
    """Whether a folder has clouds; folders of other files are told without the packages that read clouds."""
    from gtsam_rwhec.clouds.cloud import CLOUD_FORMATS

    several = (path.suffix.lower() for pattern in ("*", "*/*", "*/*/*") for path in folder.glob(pattern))
    return not set(CLOUD_FORMATS).isdisjoint(several) and bool(rw.rig.cloud_folders(folder))


def is_log(source: Path) -> bool:
    """Whether this is a log, and not a folder of CSV files."""
    return source.suffix.lower() == ".mcap" or (source.is_dir() and any(source.glob("*.mcap")))


def other_than_csv(source: Path) -> str | None:
    """What to do with a bag, or with images, that were given without a rig file; None for anything else."""
    if source.suffix.lower() == ".bag" or (source.is_dir() and any(source.glob("*.db3"))):
        return (
            f"{shown_path(source)} is a ROS bag. Convert it first: gtsam-rwhec convert {shown_path(source)} -o run.mcap"
        )
    if source.is_dir() and not any(source.glob("*.csv")):
        inside = [source, *(path for path in (*source.glob("*"), *source.glob("*/*")) if path.is_dir())]
        if any(map(rw.logs.is_image_folder, inside)):
            return (
                f"{shown_path(source)} has images. They need a rig file: --rig FILE. "
                f"gtsam-rwhec init {shown_path(source)} -o rig.yaml writes a first one"
            )
    return None


def calibrate_log(
    source: Path,
    rig: Path | None,
    output: Path,
    *,
    images: bool,
    report_images: bool = True,
    workers: int | None,
    anyway: bool = False,
    force: bool = False,
    verbose: bool = False,
) -> ExitStatus:
    """Run all stages and print the report."""
    with StageDisplay() as stage, said_in_the_report():
        described = None if rig is None else rw.rig.read_rig(rig)
        if described is not None and rw.runs.is_file_of_samples(source, described):
            samples, on_hand = rw.runs.samples_of_rig(source, described)
            say(f"{samples.reading(on_hand)}.", to_errors=True)
        calibrated = rw.calibrate_log(
            source,
            described,
            output,
            images="copy" if images else "leave_out",
            report_images=report_images,
            workers=workers,
            anyway=anyway,
            replace=force,
            progress=stage,
        )
    written, page = written_in(output)
    return show(calibrated, [written, *exported(calibrated, anyway=anyway)], verbose=verbose, page=page)
