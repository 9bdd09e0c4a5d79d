"""``gtsam-rwhec demo``: the calibration of the log that comes with the package."""

from __future__ import annotations

import shlex
from pathlib import Path
from typing import Annotated

import typer

import gtsam_rwhec as rw
from gtsam_rwhec.cli.calibrate import LogOptions, calibrate_log
from gtsam_rwhec.cli.exit_status import ExitStatus


def demo(
    output: Annotated[Path, typer.Option("--output", "-o", help="Folder for all files.")] = Path("gtsam-rwhec-demo"),
) -> ExitStatus:
    """Calibrate two cameras on a robot's hand from a log of images that comes with this package.

    The output of an earlier demo is replaced; a folder with files of another calibration is refused.
    """
    folder = rw.datasets.demo_folder()
    log, rig = folder / rw.datasets.LOG, folder / rw.datasets.RIG
    rw.pipeline.check_replaceable(output, log.name)
    command = shlex.join(["gtsam-rwhec", "calibrate", str(log), "--rig", str(rig), "-o", str(output)])
    typer.echo(f"The same as: {command}\n")
    status = calibrate_log(LogOptions(log, rig, images=False, workers=None, output=output))
    result = rw.results.read_result(output / rw.pipeline.RESULT_FILE)
    if result.refined is not None and result.log is not None:
        rw.report.print_demo(result.refined, result.log, rw.datasets.demo_truth(), output)
    return status
