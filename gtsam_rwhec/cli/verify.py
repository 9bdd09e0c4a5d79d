"""``gtsam-rwhec verify``: whether an old calibration still holds on a new log."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Annotated

import typer

import gtsam_rwhec as rw
from gtsam_rwhec.cli.calibrate import is_log, other_than_csv
from gtsam_rwhec.cli.diff import LEVEL, RESULT_HELP, LevelOption, PageOption, old_checksums, write_page_to
from gtsam_rwhec.cli.exit_status import ExitStatus
from gtsam_rwhec.cli.failures import check_output
from gtsam_rwhec.cli.options import FOLDER_OF_CSV, RigOption, SensorsOption, TargetsOption, WorkersOption
from gtsam_rwhec.cli.report import read_of
from gtsam_rwhec.cli.stage_display import StageDisplay

#: The files of a folder by which it is known again; images are not read for it.
LOG_SUFFIXES = (".mcap", ".db3", ".bag", ".csv")
#: What is said of a log that the old calibration was made from.
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


def is_of_old_log(result: Path, source: Path) -> bool:
    """Whether all files of the new log are files that the old calibration was made from, by their checksums."""
    if not (old := old_checksums(result)):
        return False
    files = [path for path in source.glob("*") if path.suffix in LOG_SUFFIXES] if source.is_dir() else [source]
    return bool(files) and {file.sha256 for file in rw.results.input_files(files)} <= old


def _problem(source: Path, scale: rw.ScaleMode, targets: str, sensors: str) -> rw.Problem:
    """The new measurements of a calibration that is of no log."""
    if is_log(source):
        raise typer.BadParameter("the old calibration is of CSV files, not of a log: give a folder of CSV files")
    if rw.logs.is_samples_file(source):
        return rw.runs.samples_problem(source).problem
    if (words := other_than_csv(source)) is not None:
        raise typer.BadParameter(words)
    return rw.read_csv(source, scale, None, None, targets, sensors)
