"""The real dataset as a log of transforms and detections: calibrated from there it is what it is from CSV."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from utias_log import rig_text, write_utias_log

import gtsam_rwhec as rw
from gtsam_rwhec.results.result_file import read_result
from gtsam_rwhec.rig import parse_rig
from gtsam_rwhec.runs.cleaning_stage import clean_log
from gtsam_rwhec.runs.detection_stage import detect_log
from gtsam_rwhec.runs.whole_runs import solve_into

SIGMA_M, ROTATION_DEG = 0.005, 0.5


@pytest.mark.slow
def test_the_same_cost_and_poses_as_from_csv(utias_folder: Path, tmp_path: Path) -> None:
    problem = rw.read_csv(utias_folder, sigma=SIGMA_M, kappa=1.0 / (2.0 * np.radians(ROTATION_DEG) ** 2))
    expected = rw.solve(problem)
    refined = rw.refine(problem, expected)
    write_utias_log(utias_folder, tmp_path / "utias.mcap")
    rig = parse_rig(rig_text(problem.targets, ROTATION_DEG, 1e3 * SIGMA_M), "rig")
    # Stage by stage, without the pictures and pages of a whole run.
    detect_log(tmp_path / "utias.mcap", rig, tmp_path / "detected.mcap")
    clean_log(tmp_path / "detected.mcap", tmp_path / "cleaned.mcap")
    found = solve_into(tmp_path / "cleaned.mcap", None, tmp_path / "out").refined
    solution = found.solution
    said = read_result(tmp_path / "out" / "result.json").log
    assert said is not None
    assert sum(track.used for track in said.outliers) == problem.number_of_measurements == 3230
    assert abs(solution.cost - expected.cost) <= 1e-12 * expected.cost
    assert abs(found.cost - refined.cost) <= 1e-9 * refined.cost
    for answer, wanted in ((solution.X, expected.X), (solution.Y, expected.Y)):
        for name, pose in wanted.items():
            np.testing.assert_allclose(answer[name].matrix(), pose.matrix(), rtol=0.0, atol=1e-12)
    for name, pose in (refined.X | refined.Y).items():
        np.testing.assert_allclose((found.X | found.Y)[name].matrix(), pose.matrix(), rtol=0.0, atol=1e-7)
