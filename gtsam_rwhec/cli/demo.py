"""``gtsam-rwhec demo``: calibrate from the log that comes with the package."""

from __future__ import annotations

import shlex
from pathlib import Path
from typing import Annotated

import typer

import gtsam_rwhec as rw
from gtsam_rwhec.cli.calibrate import calibrate_log
from gtsam_rwhec.cli.exit_status import ExitStatus
from gtsam_rwhec.cli.options import VerboseOption
from gtsam_rwhec.files.terminal_text import say


def demo(
    output: Annotated[Path, typer.Option("--output", "-o", help="Folder for all files.")] = Path("gtsam-rwhec-demo"),
    verbose: VerboseOption = False,
) -> ExitStatus:
    """Calibrate two cameras on a robot's hand. The log of their images comes with this package.

    The demo replaces its own earlier output, and goes on with its own unfinished run. It replaces nothing else.
    """
    folder = rw.datasets.demo_folder()
    log, rig = folder / rw.datasets.LOG, folder / rw.datasets.RIG
    command = shlex.join(["gtsam-rwhec", "calibrate", str(log), "--rig", str(rig), "-o", str(output)])
    earlier = rw.runs.earlier_run(output)
    is_own = earlier is not None and earlier[0] == log.name
    say(f"This is the same as: {command}{' --force' if is_own else ''}", to_errors=True)
    status = calibrate_log(log, rig, output, images=False, workers=None, force=is_own, verbose=verbose)
    result = rw.results.read_result(output / rw.runs.RESULT_FILE)
    if result.refined is not None and result.log is not None:
        rw.report.print_demo(result.refined, result.log, rw.datasets.demo_truth(), output)
    return status
