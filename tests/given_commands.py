"""A command as a user gives it, in this process: its exit status, and what it says."""

from __future__ import annotations

from contextlib import chdir
from pathlib import Path
from typing import Any

from typer.testing import CliRunner

from gtsam_rwhec.cli.app import app


def given(*arguments: object, cwd: Path = Path()) -> Any:
    """What the command leaves: `exit_code`, `stdout`, `stderr`. An exception that it lets through is an error here."""
    with chdir(cwd):
        done = CliRunner(env={"NO_PROXY": "127.0.0.1"}).invoke(app, list(map(str, arguments)))
    assert done.exception is None or isinstance(done.exception, SystemExit), done.exception
    assert "Traceback" not in done.output
    return done


def command(*arguments: object) -> tuple[int, str]:
    """Exit status, and all that was said, on one line."""
    done = given(*arguments)
    return done.exit_code, " ".join((done.stdout + " " + done.stderr).replace("│", " ").split())
