"""``gtsam-rwhec detect``: the first stage of a calibration from images."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

import gtsam_rwhec as rw
from gtsam_rwhec.cli.failures import ExitStatus, exit_status, said_in_the_report
from gtsam_rwhec.cli.shared_options import (
    AnywayOption,
    ImagesOption,
    McapOption,
    RigOption,
    VerboseOption,
    WorkersOption,
    exported,
    show,
    show_odometries,
)
from gtsam_rwhec.cli.stage_display import StageDisplay
from gtsam_rwhec.errors import RwhecError
from gtsam_rwhec.files.terminal_text import say, shown_path

if TYPE_CHECKING:
    from gtsam_rwhec.results.log_history import DetectionReport


def detect(
    source: Annotated[
        Path, typer.Argument(help="MCAP file, folder of MCAP files (a ROS 2 bag), or folder of images with poses.")
    ],
    rig: Annotated[Path, typer.Option(help="Rig file (YAML).")],
    output: McapOption,
    images: ImagesOption = False,
    draw: Annotated[Path | None, typer.Option(help="Folder for pictures: each image with its detections.")] = None,
    workers: WorkersOption = None,
) -> ExitStatus:
    """First stage: find the targets in the images and compute their poses.

    A contact sheet beside the log that is written (OUTPUT.seen.png) shows some of the images with what was found,
    rejected and not seen; --draw draws all of them. Both are written where no target was found, too.
    """
    try:
        with StageDisplay() as stage:
            report = rw.runs.detect_source(
                source,
                rw.rig.read_rig(rig),
                output,
                images="copy" if images else "leave_out",
                workers=workers,
                draw=draw,
                progress=stage,
            )
    except RwhecError:
        _say_pictures(output, draw)
        raise
    used = sum(track.used for track in report.tracks)
    rejected = sum(track.seen for track in report.tracks) - used
    for sensor, count in report.images.items():
        say(f"{sensor}: {count} images or messages; {_in_words(report, sensor)}")
    for cause in report.likely:
        say(f"Likely: {cause}")
    words = f"{used} detections to use, and {rejected} rejected ones with the reasons"
    if not report.images:
        words = "no sensor of the rig file sees targets, so there was nothing to detect"
    say(f"Written to {shown_path(output)}: {words}.")
    _say_pictures(output, draw)
    say(f"Next: gtsam-rwhec clean {shown_path(output)} -o cleaned.mcap")
    return ExitStatus.DONE


def _in_words(report: DetectionReport, sensor: str) -> str:
    """What became of the targets in a sensor's images."""
    tracks = [track for track in report.tracks if track.sensor == sensor]
    said = [
        f"{track.target} {track.used} to use" + "".join(f", {count} {why}" for why, count in track.removed.items())
        for track in tracks
    ]
    faults = report.undecoded.get(sensor, ())
    if faults:
        said.append(f"{len(faults)} images not usable, the first: {faults[0]}")
    return "; ".join(said) or "no target seen"


def _say_pictures(output: Path, draw: Path | None) -> None:
    """Name the pictures that there are."""
    sheet = rw.runs.sheet_beside(output)
    if sheet.exists():
        say(f"Contact sheet: {shown_path(sheet)}")
    if draw is not None and draw.is_dir():
        say(f"Pictures of each image: {shown_path(draw)}")


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


def solve(
    cleaned: Annotated[Path, typer.Argument(help="The log that clean wrote.")],
    output: Annotated[Path, typer.Option("--output", "-o", help="Folder for result.json and calibration.mcap.")],
    rig: RigOption = None,
    verbose: VerboseOption = False,
) -> ExitStatus:
    """Third stage: find the certified poses, refine them, and print covariances."""
    described = None if rig is None else rw.rig.read_rig(rig)
    if rw.odometry.is_of_odometries(described, cleaned):
        with StageDisplay() as stage, said_in_the_report():
            solved = rw.odometry.solve_odometries_into(cleaned, described, output, progress=stage)
        return show_odometries(solved, output, anyway=False, verbose=verbose)
    with StageDisplay() as stage, said_in_the_report():
        calibrated = rw.runs.solve_into(cleaned, described, output, progress=stage)
    messages = (
        f"Written: {shown_path(output / rw.runs.RESULT_FILE)}, {shown_path(output / rw.runs.CALIBRATION_LOG)}.",
        f"Next: gtsam-rwhec export {shown_path(output / rw.runs.CALIBRATION_LOG)} -o FOLDER",
    )
    return show(calibrated, messages, verbose=verbose)


def export(
    solved: Annotated[Path, typer.Argument(help="The calibration.mcap that solve or calibrate wrote.")],
    output: Annotated[Path, typer.Option("--output", "-o", help="Folder to write to.")],
    anyway: AnywayOption = False,
) -> ExitStatus:
    """Last stage: write a launch file, tf, URDF, cameras (Kalibr, ROS, OpenCV, COLMAP) from a solved log."""
    is_of_odometries = rw.odometry.is_of_odometries(None, solved)
    write = rw.odometry.export_odometries if is_of_odometries else rw.runs.export_solved
    with StageDisplay() as stage:
        for path in write(solved, output, anyway=anyway, progress=stage):
            say(shown_path(path))
    found = rw.odometry.read_odometries(solved) if is_of_odometries else rw.runs.read_solved(solved)
    if found.judgement.verdict is not rw.Verdict.USE:
        say(str(found.judgement), to_errors=True)
    for message in exported(found, anyway=anyway):
        say(message, to_errors=True)
    return exit_status(found.judgement, of_rig=True)
