"""``gtsam-rwhec compare`` as people type it."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

from places import DEMO


def run(*arguments: object) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "gtsam_rwhec", "compare", *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, encoding="utf-8")


def test_the_methods_that_apply_and_why_the_others_do_not(tmp_path: Path) -> None:
    output = tmp_path / "comparison.json"
    done = run(DEMO, "--sigma", 0.005, "--kappa", 6000, "--method", "lom", "--method", "shah2013", "-o", output)
    assert done.returncode == 0, done.stderr
    assert "lom " in done.stdout
    reason = "this method solves for one target and one sensor; the problem has 4 targets, 3 sensors and 11 pairs"
    assert f"  - shah2013: {reason}\n" in done.stdout
    assert "Certified globally optimal" in done.stdout
    assert [row["method"] for row in json.loads(output.read_text())["methods"]] == ["lom", "shah2013"]


def test_bad_input_is_refused_in_words(tmp_path: Path) -> None:
    for arguments, words in (
        ((tmp_path / "nowhere",), "nowhere"),
        ((DEMO, "--method", "shah"), "'shah' is not one of"),
        ((DEMO, "-o", tmp_path / "nowhere" / "comparison.json"), "cannot be written"),
    ):
        done = run(*arguments)
        assert done.returncode == 2
        assert words in done.stderr
        assert "Traceback" not in done.stderr
