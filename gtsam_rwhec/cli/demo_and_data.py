"""``gtsam-rwhec demo``: calibrate from the log that comes with the package."""

from __future__ import annotations

import shlex
from pathlib import Path
from typing import Annotated

import typer

import gtsam_rwhec as rw
from gtsam_rwhec.cli.calibrate_command import calibrate_log
from gtsam_rwhec.cli.failures import ExitStatus
from gtsam_rwhec.cli.shared_options import VerboseOption
from gtsam_rwhec.cli.stage_display import StageDisplay
from gtsam_rwhec.files.terminal_text import say, shown_path


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


def utias(
    destination: Annotated[Path, typer.Argument(help="Folder to write to; made if it does not exist.")] = Path("utias"),
    base_url: Annotated[
        str | None,
        typer.Option(help="Address of a mirror of the files.", show_default="the authors' repository on GitHub"),
    ] = None,
) -> ExitStatus:
    """Download the real dataset of the RWHEC paper: 16 tags, 8 cameras, 3230 measurements, 1.4 MB.

    Run the command again to continue an interrupted download. Existing files are verified and kept.
    """
    with StageDisplay() as stage:
        fetched = rw.datasets.fetch_utias(
            destination,
            rw.datasets.UTIAS_URL if base_url is None else base_url,
            lambda done, total, name: stage(f"downloading file {done + 1} of {total}: {name}"),
        )
    say(
        f"{len(fetched.downloaded)} files downloaded to {shown_path(fetched.folder)}, {len(fetched.already_there)} "
        "existed already; all are verified."
    )
    say(f"Next: gtsam-rwhec calibrate {shlex.quote(str(fetched.folder))} --scale shared")
    return ExitStatus.DONE
