"""``gtsam-rwhec fetch``: public measurements to calibrate from."""

from __future__ import annotations

import shlex
from pathlib import Path
from typing import Annotated

import typer

import gtsam_rwhec as rw
from gtsam_rwhec.cli.exit_status import ExitStatus
from gtsam_rwhec.cli.stage_display import StageDisplay
from gtsam_rwhec.files.terminal_text import say, shown_path


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
