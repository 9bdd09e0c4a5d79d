"""How often a log's solution does what takes long: one calibration, few problems, few refinements from corners."""

from __future__ import annotations

import sys
from collections import Counter
from pathlib import Path
from types import FrameType

import pytest
from places import REPOSITORY

from gtsam_rwhec.calibration.stages import calibrate
from gtsam_rwhec.fitting.corner_refinement import refine_corners
from gtsam_rwhec.problem.problem import Problem
from gtsam_rwhec.rig import read_rig
from gtsam_rwhec.runs import clean_log, detect_log, solve_log

CELL = REPOSITORY / "data" / "cell"


@pytest.mark.slow
def test_the_shipped_log_is_solved_by_one_calibration(tmp_path: Path) -> None:
    rig = read_rig(CELL / "rig.yaml")
    detect_log(CELL / "robot_cell.mcap", rig, tmp_path / "detected.mcap")
    clean_log(tmp_path / "detected.mcap", tmp_path / "cleaned.mcap", rig)
    codes = {
        getattr(function, "__wrapped__", function).__code__: name
        for name, function in (
            ("calibrations", calibrate), ("problems", Problem.__init__), ("refinements from corners", refine_corners),
        )
    }  # fmt: skip
    count = Counter[str]()

    def on_event(frame: FrameType, event: str, argument: object) -> None:
        if event == "call" and frame.f_code in codes:
            count[codes[frame.f_code]] += 1

    before = sys.getprofile()
    sys.setprofile(on_event)
    try:
        solve_log(tmp_path / "cleaned.mcap")
    finally:
        sys.setprofile(before)
    assert count["calibrations"] == 1
    assert 0 < count["problems"] <= 20
    assert 0 < count["refinements from corners"] <= 5
