"""``diff``, ``verify`` and ``accept``: what changed, does a calibration still hold, is it good enough."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Annotated

import typer

import gtsam_rwhec as rw
from gtsam_rwhec.cli.calibrate_command import is_log, other_than_csv
from gtsam_rwhec.cli.failures import ExitStatus, check_output
from gtsam_rwhec.cli.report_command import read_of
from gtsam_rwhec.cli.shared_options import FOLDER_OF_CSV, RigOption, SensorsOption, TargetsOption, WorkersOption
from gtsam_rwhec.cli.stage_display import StageDisplay
from gtsam_rwhec.errors import FileFormatError, OptionError
from gtsam_rwhec.files.terminal_text import say, shown_path

#: A copy of ``rw.results.LEVEL``, as ``--help`` must not import that.
LEVEL = 0.01
#: A copy of ``rw.results.acceptance.LEVEL``.
PROBABILITY = 0.95
RESULT_HELP = "result.json, or the folder that calibrate wrote."
LevelOption = Annotated[
    float, typer.Option(help="How often it may say that something changed where nothing did: 0.01 is once in 100.")
]


PageOption = Annotated[
    Path | None, typer.Option("--output", "-o", help="An HTML file for the same as a page, which needs no network.")
]


def write_page_to(
    found: rw.results.Difference | rw.results.Verification, output: Path | None, compared: tuple[Path, Path]
) -> None:
    """Write the page, if one is asked for, and say so."""
    if output is not None:
        rw.report.write_changes(found, output, compared)
        say(f"Written to {shown_path(output)}.", to_errors=True)


def diff(
    old: Annotated[Path, typer.Argument(help=f"The old calibration: {RESULT_HELP}")],
    new: Annotated[Path, typer.Argument(help=f"The new calibration: {RESULT_HELP}")],
    level: LevelOption = LEVEL,
    frame: Annotated[
        list[str] | None,
        typer.Option(help="Test only this frame, most sharply; repeat the option for several.", show_default="all"),
    ] = None,
    clocks_may_change: Annotated[
        bool, typer.Option("--clocks-may-change", help="Do not test the time offsets of sensors.")
    ] = False,
    other_arm: Annotated[
        bool, typer.Option("--other-arm", help="The carriers' poses of NEW come from another arm or tracker.")
    ] = False,
    output: PageOption = None,
) -> ExitStatus:
    """What moved from an old calibration to a new one, and whether by more than chance; exit status 1 if so."""
    check_output(output, *(file for each in (old, new) for file in read_of(each)))
    checksums = old_checksums(old)
    found = rw.results.difference(
        rw.results.read_calibration(old),
        rw.results.read_calibration(new),
        level=level,
        frames=frame or (),
        clocks_may_change=clocks_may_change,
        same_arm=not other_arm,
        same_measurements=bool(checksums) and checksums == old_checksums(new),
    )
    rw.report.print_difference(found)
    write_page_to(found, output, (old, new))
    if found.test is None and not found.is_same:
        return ExitStatus.BAD_INPUT
    return ExitStatus.CHANGED if found.has_changed else ExitStatus.DONE


def old_checksums(result: Path) -> set[str]:
    """The checksums of a calibration's input files; empty if no readable file beside its result has them."""
    evidence = rw.results.evidence_path(rw.results.result_path(result))
    if not evidence.exists():
        return set()
    try:
        inputs = rw.results.read_evidence(evidence).inputs
    except FileFormatError:  # of another version: the numbers themselves are compared all the same
        return set()
    return set() if inputs is None else {file.sha256 for file in inputs.files}


#: The files by which a folder is recognised; images are not read for this.
LOG_SUFFIXES = (".mcap", ".db3", ".bag", ".csv")
#: The message for a log that the old calibration was made from.
SAME_LOG = "The old calibration was made from this very log, so that it agrees says nothing: give a log recorded later."


def verify(
    result: Annotated[Path, typer.Argument(help=f"The old calibration: {RESULT_HELP}")],
    source: Annotated[
        Path,
        typer.Argument(
            help="The new measurements: MCAP log, folder of images or samples as for calibrate, or for a calibration "
            f"of CSV files a {FOLDER_OF_CSV}."
        ),
    ],
    rig: RigOption = None,
    level: LevelOption = LEVEL,
    targets_may_move: Annotated[
        bool,
        typer.Option("--targets-may-move", help="Targets may stand elsewhere than before: test the sensors alone."),
    ] = False,
    targets: TargetsOption = "tag",
    sensors: SensorsOption = "cam",
    workers: WorkersOption = None,
    output: PageOption = None,
) -> ExitStatus:
    """Whether an old calibration still holds on a new log, without calibrating anew: the check before a shift.

    Exit status 0: it holds. 1: it no longer does. 3: nothing contradicts it, but a sensor of it was not seen.
    """
    check_output(output, source, *read_of(result), *([] if rig is None else [rig]))
    old = rw.results.read_calibration(result) if result.suffix.lower() != ".mcap" else None
    with StageDisplay() as stage:
        if old is not None and old.log is None:
            problem = _problem(source, old.solution.scale_mode, targets, sensors)
            stage("testing the old poses")
            found = rw.results.verify(old, problem, level=level, targets_may_move=targets_may_move, progress=stage)
        else:
            found = rw.runs.verify_log(
                result,
                source,
                None if rig is None else rw.rig.read_rig(rig),
                level=level,
                targets_may_move=targets_may_move,
                workers=workers,
                progress=stage,
            )
    if is_of_old_log(result, source):
        found = replace(found, remarks=(SAME_LOG, *found.remarks))
    rw.report.print_verification(found)
    write_page_to(found, output, (result, source))
    if not found.holds:
        return ExitStatus.CHANGED
    return ExitStatus.NOT_UNIQUE if found.unchecked_sensors else ExitStatus.DONE


#: The exit status of each answer of ``accept``.
STATUSES = {
    "accepted": ExitStatus.DONE,
    "not_accepted_yet": ExitStatus.NOT_UNIQUE,
    "not_determined": ExitStatus.NOT_UNIQUE,
    "rejected": ExitStatus.CHANGED,
}


def accept(
    result: Annotated[Path, typer.Argument(help=f"The calibration: {RESULT_HELP}")],
    source: Annotated[
        Path,
        typer.Argument(
            help="CSV file of touches, with the columns sensor_x_m, sensor_y_m, sensor_z_m, known_x_m, known_y_m, "
            "known_z_m; or measurements of a board that the calibration has not seen, as for verify: also a "
            f"{FOLDER_OF_CSV}."
        ),
    ],
    limit_mm: Annotated[float, typer.Option("--limit-mm", help="The largest allowed error of a point, mm.")],
    sensor: Annotated[str | None, typer.Option(help="The sensor that is tested.", show_default="the only one")] = None,
    box: Annotated[
        tuple[float, float, float, float, float, float] | None,
        typer.Option(
            help="Where it must hold: XMIN YMIN ZMIN XMAX YMAX ZMAX, m, in the frame that carries the sensor.",
            show_default="the box around the points",
        ),
    ] = None,
    ball: Annotated[
        tuple[float, float, float, float] | None, typer.Option(help="The same as a ball: X Y Z RADIUS, m.")
    ] = None,
    level: Annotated[float, typer.Option(help="Probability of the statement.")] = PROBABILITY,
    noise_mm: Annotated[
        tuple[float, float] | None,
        typer.Option(
            help="Standard deviation of one touch along an axis across the line of sight, and along it, mm.",
            show_default="that of the residuals",
        ),
    ] = None,
    known_to_mm: Annotated[
        float, typer.Option(help="Error that all known points may share, as that of the tool tip, mm.")
    ] = 0.0,
    write: Annotated[bool, typer.Option("--write/--no-write", help="Whether the result file gets the answer.")] = True,
    rig: RigOption = None,
    targets: TargetsOption = "tag",
    sensors: SensorsOption = "cam",
    workers: WorkersOption = None,
) -> ExitStatus:
    """Whether a calibration is off by less than a limit in a volume: known points, or a new board, prove it with 95 %.

    A calibration that is off by the limit is accepted in at most 5 % of all cases.

    Exit status 0: accepted. 1: rejected. 3: not accepted yet, touch more; or the touches cannot tell.
    """
    if box is not None and ball is not None:
        raise typer.BadParameter("give --box or --ball, not both")
    volume = None if box is None else rw.results.Volume.box(box[:3], box[3:])
    volume = volume if ball is None else rw.results.Volume.ball(ball[:3], ball[3])
    old = rw.results.read_calibration(result)
    with StageDisplay() as stage:
        if rw.results.is_touches_file(source):
            measured: rw.Problem | rw.results.Touches | None = rw.results.read_touches(source)
        else:
            if is_of_old_log(result, source):
                raise OptionError(f"{source}: the calibration was made from it, which proves nothing: give a new one")
            measured = _problem(source, old.solution.scale_mode, targets, sensors) if old.log is None else None
        if measured is None:
            found = rw.runs.accept_log(
                result, source, None if rig is None else rw.rig.read_rig(rig), limit_mm=limit_mm, sensor=sensor,
                volume=volume, level=level, noise_mm=noise_mm, known_to_mm=known_to_mm, workers=workers, progress=stage,
            )  # fmt: skip
        else:
            stage("testing the poses")
            found = rw.results.accept(
                old, measured, limit_mm=limit_mm, sensor=sensor, volume=volume, level=level, noise_mm=noise_mm,
                known_to_mm=known_to_mm,
            )  # fmt: skip
            found = replace(found, source=source.name)
    rw.report.print_acceptance(found)
    if write:
        rw.results.write_acceptance(found, result)
        file = shown_path(rw.results.result_path(result))
        say(f"Written into {file}; gtsam-rwhec report {shown_path(result)} shows it.", to_errors=True)
    return STATUSES[found.answer]


def is_of_old_log(result: Path, source: Path) -> bool:
    """Whether all files of the new log are files that the old calibration was made from, by their checksums."""
    if not (old := old_checksums(result)):
        return False
    files = [path for path in source.glob("*") if path.suffix in LOG_SUFFIXES] if source.is_dir() else []
    files = [source] if source.is_file() else files  # what is not there, its reader says
    return bool(files) and {file.sha256 for file in rw.results.input_files(files)} <= old


def _problem(source: Path, scale: rw.ScaleMode, targets: str, sensors: str) -> rw.Problem:
    """The new measurements, for a calibration that was not made from a log."""
    if is_log(source):
        raise typer.BadParameter("the old calibration is of CSV files, not of a log: give a folder of CSV files")
    if rw.logs.is_samples_file(source):
        return rw.runs.samples_problem(source).problem
    if (words := other_than_csv(source)) is not None:
        raise typer.BadParameter(words)
    return rw.read_csv(source, scale, None, None, targets, sensors)
