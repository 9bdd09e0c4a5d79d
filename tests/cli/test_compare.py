"""``gtsam-rwhec compare`` as people type it."""

from __future__ import annotations

import json
from pathlib import Path

from given_commands import given
from places import DEMO


def test_the_methods_that_apply_and_why_the_others_do_not(tmp_path: Path) -> None:
    output = tmp_path / "comparison.json"
    done = given(
        "compare", DEMO, "--sigma", 0.005, "--kappa", 6000, "--method", "lom", "--method", "shah2013", "-o", output
    )
    assert done.exit_code == 0, done.stderr
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
        done = given("compare", *arguments)
        assert done.exit_code == 2
        assert words in done.stderr
