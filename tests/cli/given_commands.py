"""A command as a user gives it, in this process: its exit status, and all that it says in one line."""

from __future__ import annotations

from typer.testing import CliRunner

from gtsam_rwhec.cli.app import app


def command(*arguments: object) -> tuple[int, str]:
    """Exit status, and all that was said, on one line."""
    done = CliRunner().invoke(app, list(map(str, arguments)))
    assert done.exception is None or isinstance(done.exception, SystemExit), done.exception
    said = " ".join((done.stdout + " " + done.stderr).replace("│", " ").split())
    assert "Traceback" not in said
    return done.exit_code, said
