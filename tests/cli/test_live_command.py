"""``gtsam-rwhec live`` as a process: what it says, and its exit status, where nothing could be taken."""

from __future__ import annotations

from pathlib import Path

from given_commands import command
from places import REPOSITORY

CELL = REPOSITORY / "data" / "cell"


def test_a_robot_that_never_stands_still_leaves_no_calibration_and_says_so(tmp_path: Path) -> None:
    status, said = command(
        "live", CELL / "eye_to_hand.mcap", "--rig", CELL / "eye_to_hand.yaml", "-o", tmp_path / "cell", "--when-still",
        "--terminal", "--speed", "20",
    )  # fmt: skip
    assert status == 3, said
    assert "Nothing was taken: the robot never stood still" in " ".join(said.split())
    assert not (tmp_path / "cell" / "calibration").exists()
