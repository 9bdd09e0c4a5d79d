"""The subcommands that work on logs: init, convert, detect, clean, solve, export; and calibrate with a rig file."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from gtsam_rwhec.cli.exit_status import HELP, ExitStatus, exit_status
from gtsam_rwhec.cli.failures import failures_in_words
from gtsam_rwhec.cli.stage_display import StageDisplay
from gtsam_rwhec.errors import FileFormatError, LogError, NotCertifiedWarning, NotUniqueWarning
from gtsam_rwhec.files.atomic_write import write_atomically
from gtsam_rwhec.files.printable import printable
from gtsam_rwhec.first_rig import first_rig
from gtsam_rwhec.logs import convert_ros_bag, open_log, write_image_folder
from gtsam_rwhec.logs.image_folder import is_image_folder
from gtsam_rwhec.pipeline.all_stages import calibrate_log, export_solved, solve_into
from gtsam_rwhec.pipeline.cleaning_stage import clean_log
from gtsam_rwhec.pipeline.detection_stage import detect_log
from gtsam_rwhec.pipeline.detections_in_images import draw_log
from gtsam_rwhec.pipeline.log_contract import CLEAN_LOG, RESULT_FILE
from gtsam_rwhec.pipeline.solving_stage import Calibrated
from gtsam_rwhec.report import print_refined, print_solution, report_console
from gtsam_rwhec.report.log_report import print_log
from gtsam_rwhec.rig import read_rig

RigOption = Annotated[Path | None, typer.Option("--rig", help="Rig file (YAML); left out, the one inside the log.")]
ImagesOption = Annotated[bool, typer.Option("--images", help="Copy the images too; they are large.")]
WorkersOption = Annotated[int | None, typer.Option(min=1, help="Threads for detection.", show_default="all cores")]


class Columns(StrEnum):
    """The order of the numbers of a pose in a text file."""

    txyz_qxyzw = "tx ty tz qx qy qz qw"
    txyz_qwxyz = "tx ty tz qw qx qy qz"
    qwxyz_txyz = "qw qx qy qz tx ty tz"
    qxyzw_txyz = "qx qy qz qw tx ty tz"


def add_log_commands(app: typer.Typer) -> None:
    """Register them."""
    for command in (init, convert, detect, clean, solve, export):
        app.command(epilog=HELP)(command)


def init(
    log: Annotated[Path, typer.Argument(help="MCAP file, or a folder of them (a ROS 2 bag).")],
    output: Annotated[Path, typer.Option("--output", "-o", help="Rig file to write.")] = Path("rig.yaml"),
) -> None:
    """Look at a log and write a first rig file, with what a person must fill in marked."""
    with failures_in_words():
        if output.exists():
            raise FileFormatError(f"{output} is there already; it may have been filled in by hand. Give another name.")
        with StageDisplay() as stage:
            stage(f"looking at {log}")
            with open_log(log) as opened:
                text, notes = first_rig(opened, output)
        _write_text(output, text)
        for note in notes:
            typer.echo(printable(note))
        typer.echo(
            f"Written to {output}. Fill in what is marked, then: gtsam-rwhec calibrate {log} --rig {output} -o out"
        )


def convert(
    source: Annotated[Path, typer.Argument(help="ROS 1 bag, folder of a ROS 2 db3 bag, or folder of images.")],
    output: Annotated[Path, typer.Option("--output", "-o", help="MCAP file to write.")],
    poses: Annotated[
        Path | None,
        typer.Option(
            help="For a folder of images: text or CSV file of poses, a name or stamp and seven numbers a line."
        ),
    ] = None,
    columns: Annotated[Columns, typer.Option(help="Their order.")] = Columns.txyz_qxyzw,
    parent: Annotated[str, typer.Option(help="Poses are those of --child in this frame.")] = "base",
    child: Annotated[str, typer.Option(help="The frame that moves.")] = "hand",
    camera: Annotated[str, typer.Option(help="Name of the camera.")] = "camera",
) -> None:
    """Make an MCAP log of a ROS bag, or of a folder of images with a file of poses."""
    with failures_in_words(), StageDisplay() as stage:
        stage(f"converting {source}")
        if poses is None and is_image_folder(source):
            raise LogError(f"{source} is a folder of images, which say nothing of where they were taken: give --poses")
        if poses is None:
            count = convert_ros_bag(source, output)
            said = f"{count} messages"
        else:
            images, number = write_image_folder(
                source, poses, output, columns=columns.value, parent=parent, child=child, camera=camera
            )
            said = f"{images} images and {number} poses"
        typer.echo(f"{said} written to {output}.")


def detect(
    log: Annotated[Path, typer.Argument(help="MCAP file, or a folder of them (a ROS 2 bag).")],
    rig: Annotated[Path, typer.Option("--rig", help="Rig file (YAML).")],
    output: Annotated[Path, typer.Option("--output", "-o", help="MCAP file to write.")],
    images: ImagesOption = False,
    draw: Annotated[Path | None, typer.Option(help="Write every image with what was detected to this folder.")] = None,
    workers: WorkersOption = None,
) -> None:
    """First stage: images to poses of targets."""
    with failures_in_words(), StageDisplay() as stage:
        report = detect_log(
            log, read_rig(rig), output, images="copy" if images else "leave_out", workers=workers, progress=stage
        )
        used = sum(track.used for track in report.tracks)
        removed = sum(sum(track.removed.values()) for track in report.tracks)
        typer.echo(f"{used} detections to use, {removed} rejected, each with its reason, in {output}.")
        if draw is not None:
            typer.echo(f"{draw_log(log, output, draw, progress=stage)} images drawn in {draw}.")


def clean(
    detected: Annotated[Path, typer.Argument(help="What detect wrote.")],
    output: Annotated[Path, typer.Option("--output", "-o", help="MCAP file to write.")],
    rig: RigOption = None,
) -> None:
    """Second stage: synchronise with the carriers' poses, and take out what should not be used."""
    with failures_in_words(), StageDisplay() as stage:
        report = clean_log(detected, output, None if rig is None else read_rig(rig), progress=stage)
        used = sum(track.used for track in report.tracks)
        typer.echo(f"{used} measurements to use, the others with their reasons, in {output}.")


def solve(
    cleaned: Annotated[Path, typer.Argument(help="What clean wrote.")],
    output: Annotated[Path, typer.Option("--output", "-o", help="Folder for result.json and clean.mcap.")],
    rig: RigOption = None,
) -> None:
    """Third stage: certified solution, refined, with covariances."""
    with failures_in_words():
        with StageDisplay() as stage, _said_in_the_report():
            calibrated = solve_into(cleaned, None if rig is None else read_rig(rig), output, progress=stage)
        _print(calibrated)
        typer.echo(f"Written: {output / RESULT_FILE}, {output / CLEAN_LOG}.", err=True)
        raise typer.Exit(_status(calibrated))


def export(
    solved: Annotated[Path, typer.Argument(help="The clean.mcap that solve or calibrate wrote.")],
    output: Annotated[Path, typer.Option("--output", "-o", help="Folder to write to.")],
) -> None:
    """Last stage: launch file, tf, URDF, Kalibr camchain and plots from a solved log."""
    with failures_in_words(), StageDisplay() as stage:
        for path in export_solved(solved, output, progress=stage):
            typer.echo(str(path))


def is_log(source: Path, rig: Path | None) -> bool:
    """Whether a log is meant, and not a folder of CSV files."""
    return rig is not None or source.suffix.lower() == ".mcap" or (source.is_dir() and any(source.glob("*.mcap")))


def calibrate_from_log(log: Path, rig: Path | None, output: Path, *, images: bool, workers: int | None) -> None:
    """Run all stages, print the report and exit with its status."""
    with failures_in_words():
        with StageDisplay() as stage, _said_in_the_report():
            calibrated = calibrate_log(
                log,
                None if rig is None else read_rig(rig),
                output,
                images="copy" if images else "leave_out",
                workers=workers,
                progress=stage,
            )
        _print(calibrated)
        typer.echo(f"Written to {output}: {', '.join(sorted(path.name for path in output.iterdir()))}.", err=True)
        raise typer.Exit(_status(calibrated))


def _print(calibrated: Calibrated) -> None:
    print_log(calibrated.log)
    print_solution(calibrated.refined.solution)
    report_console().print()
    print_refined(calibrated.refined)


def _status(calibrated: Calibrated) -> ExitStatus:
    status = exit_status(calibrated.refined.solution)
    if status is ExitStatus.CERTIFIED and calibrated.log.contradictions:
        return ExitStatus.CONTRADICTED
    if status is ExitStatus.CERTIFIED and calibrated.refined.free_directions:
        return ExitStatus.NOT_UNIQUE
    return status


@contextmanager
def _said_in_the_report() -> Iterator[None]:
    """Leave warnings to the report that says the same, with the directions."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", NotUniqueWarning)
        warnings.simplefilter("ignore", NotCertifiedWarning)
        yield


def _write_text(path: Path, text: str) -> None:
    try:
        write_atomically(path, text.encode("utf-8"))
    except OSError as error:
        raise FileFormatError(f"{path} cannot be written: {error.strerror}.") from error
