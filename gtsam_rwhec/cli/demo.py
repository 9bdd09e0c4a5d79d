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
    """Calibrate two cameras on a robot's hand from a log of images that comes with this package."""
    folder = rw.datasets.demo_folder()
    log, rig = folder / rw.datasets.LOG, folder / rw.datasets.RIG
    command = shlex.join(["gtsam-rwhec", "calibrate", str(log), "--rig", str(rig), "-o", str(output)])
    typer.echo(f"The same as: {command}\n")
    return calibrate_log(LogOptions(log, rig, images=False, workers=None, output=output))
