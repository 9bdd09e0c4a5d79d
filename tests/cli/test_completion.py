"""What a shell asks for when the user presses the tab key."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest
from typer.testing import CliRunner

from gtsam_rwhec.cli.app import app
from gtsam_rwhec.methods import METHODS


def complete(instruction: str, **environment: str) -> str:
    """What the command prints for a shell."""
    done = CliRunner(env={"_GTSAM_RWHEC_COMPLETE": instruction, **environment}).invoke(app)
    assert done.exception is None or isinstance(done.exception, SystemExit), done.exception
    return str(done.stdout)


def words(line: str) -> list[str]:
    """What bash would offer at the end of a line."""
    count = str(len(line.split(" ")) - 1)
    return complete("complete_bash", COMP_WORDS=line, COMP_CWORD=count).split()


@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
def test_a_shell_gets_its_script(shell: str) -> None:
    script = complete(f"source_{shell}")
    assert "gtsam-rwhec" in script
    assert "_GTSAM_RWHEC_COMPLETE=" in script


def test_subcommands_options_and_values() -> None:
    assert words("gtsam-rwhec c") == ["calibrate", "convert", "clean", "compare"]
    assert words("gtsam-rwhec fetch ") == ["utias"]
    assert words("gtsam-rwhec calibrate --carrier") == ["--carrier-noise-deg", "--carrier-noise-mm"]
    assert words("gtsam-rwhec calibrate --scale ") == ["known", "shared", "per_target"]
    assert words("gtsam-rwhec calibrate --robust g") == ["gnc"]


def test_the_names_of_methods() -> None:
    """In a process of its own, as a shell asks."""
    line = "gtsam-rwhec compare --method "
    asked = {"_GTSAM_RWHEC_COMPLETE": "complete_bash", "COMP_WORDS": line, "COMP_CWORD": "3"}
    done = subprocess.run([sys.executable, "-m", "gtsam_rwhec"], capture_output=True, text=True, env=os.environ | asked)
    assert "Traceback" not in done.stderr
    assert done.stdout.split() == list(METHODS)
