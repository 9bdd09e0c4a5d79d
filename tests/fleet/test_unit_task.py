"""A robot's calibration from the measurements of its logs: by corners, with one clock, with covariances that hold."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from fleets import write_fleet
from rwhec_factors import se3

import gtsam_rwhec as rw
from gtsam_rwhec import fleet


@pytest.mark.slow
def test_clocks_of_several_logs_are_estimated_as_one(tmp_path: Path) -> None:
    """Rotations tell each log another offset; the poses of all tell one, with its deviation."""
    made = write_fleet(tmp_path, 1, 3, images=20, tags=2)
    rig = Path(made.rig)
    rig.write_text(rig.read_text(encoding="utf-8").replace("tags, ", "tags, time_offset: estimate, "), encoding="utf-8")
    (row,) = fleet.run(fleet.read_manifest(made.manifest), str(tmp_path / "out")).rows
    assert rw.Ground.COVARIANCE_DOUBTED not in row.grounds
    log = rw.results.read_result(tmp_path / "out" / str(row.result)).log
    assert log is not None
    (offset,) = log.time_offsets
    assert offset.sigma_s is not None
    assert abs(offset.offset_s) < 5.0 * offset.sigma_s < 0.005


def test_the_answer_is_from_corners(tmp_path: Path) -> None:
    made = write_fleet(tmp_path, 1, 2, images=12, tags=2)
    (row,) = fleet.run(fleet.read_manifest(made.manifest), str(tmp_path / "out")).rows
    assert row.failure is None, row.failure
    assert row.verdict is not rw.Verdict.DO_NOT_USE
    written = rw.read_refined(tmp_path / "out" / str(row.result))
    assert written.reprojection is not None
    assert abs(written.Y["cam_0"].translation() - made.truth["robot_000"]["cam_0"][:3, 3]).max() < 0.002


@pytest.mark.slow
def test_a_camera_that_moved_between_logs_is_said(tmp_path: Path) -> None:
    step = se3.expmap(np.array([[0.0, 0.003, 0.0, 0.002, 0.0, 0.001]]))[0]
    made = write_fleet(tmp_path, 2, 3, tags=2, seed=7, moved={(0, "cam_0"): (2, step)})
    moved, still = fleet.run(fleet.read_manifest(made.manifest), str(tmp_path / "out")).rows
    assert moved.grounds[0] is rw.Ground.COVARIANCE_DOUBTED
    assert "night_02.mcap puts it" in moved.reason
    assert still.verdict is rw.Verdict.USE


def test_a_robot_with_an_odometry_is_refused(tmp_path: Path) -> None:
    made = write_fleet(tmp_path, 1, 1, images=8, tags=1)
    rig = Path(made.rig)
    text = rig.read_text(encoding="utf-8").replace("targets:\n", "  wheels: {odometry: {topic: /odom}}\ntargets:\n")
    rig.write_text(text.replace("  targets: base", "  targets: base", 1), encoding="utf-8")
    (row,) = fleet.run(fleet.read_manifest(made.manifest), str(tmp_path / "out")).rows
    assert "wheels" in str(row.failure)
