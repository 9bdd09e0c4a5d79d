"""Corners of cleaned logs, from the images of other people, refined from with everything free."""

from __future__ import annotations

from pathlib import Path

import pytest
from cells_of_others import CIRCLES, WORKCELL

import gtsam_rwhec as rw
from gtsam_rwhec.errors import LogError
from gtsam_rwhec.pipeline import clean_log, detect_log, read_corners, write_folder_log
from gtsam_rwhec.reprojection import held_out_errors
from gtsam_rwhec.rig.rig_file import parse_rig


def corners_of(folder: Path, text: str, out: Path) -> rw.Observations:
    rig = parse_rig(text, "rig.yaml", folder)
    write_folder_log(folder, rig, out / "raw.mcap")
    detect_log(out / "raw.mcap", rig, out / "detected.mcap")
    clean_log(out / "detected.mcap", out / "clean.mcap", rig)
    return read_corners(out / "clean.mcap")


def test_a_workcell_of_other_people(workcell_camera2: Path, tmp_path: Path) -> None:
    observations = corners_of(workcell_camera2, WORKCELL, tmp_path)
    view = observations.views["board", "camera2"]
    assert view.pixels.shape == (34, 12, 2)
    found = rw.calibrate_corners(observations, rw.CornerOptions(stated="calibration"))
    refined = found.refined
    assert refined.intrinsics["camera2"].rms_px < 0.07
    assert refined.intrinsics["camera2"].widened == 1.0
    # its simulator has the principal point half a pixel or a pixel from where it is stated
    assert refined.intrinsics["camera2"].camera.K[0, 2] == pytest.approx(959.5, abs=4.0)
    assert refined.noise.carrier_m < 1e-4
    assert held_out_errors(found.observations, refined)["camera2"].rms_mm < 0.2


def test_nominal_intrinsics_of_other_people(circle_grid_10x10: Path, tmp_path: Path) -> None:
    """With f, c and the spacing as stated the corners of images that are left out are predicted to 4.6 mm."""
    observations = corners_of(circle_grid_10x10, CIRCLES, tmp_path)
    options = rw.CornerOptions(stated="nominal", carrier_noise="exact", size_share=0.03, outliers=False)
    found = rw.calibrate_corners(observations, options)
    camera = found.refined.intrinsics["camera"].camera
    assert camera.K[0, 0] == pytest.approx(530.0, abs=20.0)
    assert found.refined.shapes["grid"][0] == pytest.approx(-0.02, abs=0.01)
    assert held_out_errors(found.observations, found.refined, options)["camera"].rms_mm < 0.7 * 4.6


def test_a_log_that_no_stage_wrote_has_no_corners(workcell_camera2: Path, tmp_path: Path) -> None:
    write_folder_log(workcell_camera2, parse_rig(WORKCELL, "rig.yaml"), tmp_path / "raw.mcap")
    with pytest.raises(LogError, match=r"raw\.mcap"):
        read_corners(tmp_path / "raw.mcap")
