"""What starting does not bring in. How long it takes is in benchmarks/start_time.py."""

from __future__ import annotations

import json
import subprocess
import sys

import pytest

HEAVY = {
    "clarabel", "cv2", "gtsam", "matplotlib", "mcap", "numpy", "pydantic", "requests", "scipy", "scipy.sparse.linalg",
    "scipy.optimize", "loky", "yaml",
}  # fmt: skip


def brought_in(code: str) -> set[str]:
    """Those of the heavy modules that a program has imported when it ends."""
    end = "\nimport json, sys\nprint('\\n' + json.dumps(sorted(sys.modules)))"
    done = subprocess.run([sys.executable, "-c", code + end], capture_output=True, text=True, check=True)
    return HEAVY & set(json.loads(done.stdout.splitlines()[-1]))


def command(*arguments: str) -> str:
    """A program that does what the command does with these arguments."""
    return (
        "import sys\nfrom gtsam_rwhec.cli import main\n"
        f"sys.argv[1:] = {list(arguments)}\n"
        "try:\n    main()\nexcept SystemExit as end:\n    assert end.code == 0, end.code"
    )


@pytest.mark.parametrize("code", ["import gtsam_rwhec", "import gtsam_rwhec; dir(gtsam_rwhec)", command("--help")])
def test_starting_brings_in_nothing_heavy(code: str) -> None:
    assert brought_in(code) == set()


@pytest.mark.parametrize("subcommand", [["calibrate"], ["compare"], ["fetch", "utias"]])
def test_nor_does_the_help_of_a_subcommand(subcommand: list[str]) -> None:
    assert brought_in(command(*subcommand, "--help")) <= {"pydantic"}  # by which typer itself reads defaults


def test_solving_brings_in_no_images_and_no_files() -> None:
    code = "import gtsam_rwhec as rw\nrw.Problem, rw.solve, rw.refine, rw.certify"
    assert brought_in(code) == {"clarabel", "gtsam", "numpy", "scipy"}


def test_vision_brings_in_no_drawing_and_no_downloads() -> None:
    code = "import gtsam_rwhec as rw\nrw.detect.Detector, rw.runs.calibrate_log"
    assert brought_in(code).isdisjoint({"matplotlib", "requests", "scipy.optimize"})
