"""Corners of cleaned logs, from the images of other people, refined from with everything free."""

from __future__ import annotations

import shutil
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from cells_of_others import CIRCLES, WORKCELL
from rwhec_factors import se3

import gtsam_rwhec as rw
from gtsam_rwhec.errors import LogError, LogWarning
from gtsam_rwhec.fitting import held_out_errors
from gtsam_rwhec.geometry.trajectory import Trajectory
from gtsam_rwhec.logs import open_log
from gtsam_rwhec.logs.records import DetectionRecord
from gtsam_rwhec.rig.rig_file import parse_rig
from gtsam_rwhec.runs import clean_log, detect_log, read_corners, solve_log, write_folder_log
from gtsam_rwhec.runs.carrier_motion import CarrierMotion
from gtsam_rwhec.runs.measured_pairs import read_pairs
from gtsam_rwhec.runs.solving_stage import CleanedLog


def corners_of(folder: Path, text: str, out: Path) -> rw.Observations:
    rig = parse_rig(text, "rig.yaml", folder)
    write_folder_log(folder, rig, out / "raw.mcap")
    detect_log(out / "raw.mcap", rig, out / "detected.mcap")
    clean_log(out / "detected.mcap", out / "calibration.mcap", rig)
    return read_corners(out / "calibration.mcap")


@pytest.fixture(scope="module")
def workcell_log(workcell_camera2: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The cleaned log of the workcell."""
    folder = tmp_path_factory.mktemp("workcell")
    corners_of(workcell_camera2, WORKCELL, folder)
    return folder / "calibration.mcap"


@pytest.fixture(scope="module")
def circles_log(circle_grid_10x10: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The cleaned log of the grid of circles."""
    folder = tmp_path_factory.mktemp("circles")
    corners_of(circle_grid_10x10, CIRCLES, folder)
    return folder / "calibration.mcap"


def test_a_workcell_of_other_people(workcell_log: Path) -> None:
    observations = read_corners(workcell_log)
    view = observations.views["board", "camera2"]
    assert view.pixels.shape == (34, 12, 2)
    assert view.twist is None  # between stations nothing is known of the path
    found = rw.calibrate_corners(observations, rw.CornerOptions(stated="calibration"))
    refined = found.refined
    assert refined.intrinsics["camera2"].rms_px < 0.07
    assert refined.intrinsics["camera2"].widened == 1.0
    # its simulator has the principal point half a pixel or a pixel from where it is stated
    assert refined.intrinsics["camera2"].camera.K[0, 2] == pytest.approx(959.5, abs=4.0)
    assert refined.noise.carrier_m < 1e-4
    assert held_out_errors(refined)["camera2"].rms_mm < 0.2


def test_the_log_road_refines_a_workcell_of_other_people_from_corners(workcell_log: Path) -> None:
    """Nominal intrinsics in its rig file: the simulator's own are within what the corners say of theirs."""
    solved = solve_log(workcell_log)
    assert solved.judgement.verdict is rw.Verdict.USE
    found = solved.refined.intrinsics["camera2"]
    assert found.stated_as == "nominal"
    assert found.values[2] == pytest.approx(959.5, abs=4.0)
    assert solved.refined.reprojection is not None
    sensor = solved.refined.reprojection.sensors["camera2"]
    assert sensor.held_out_mm is not None
    assert sensor.held_out_mm < 0.2
    # the log keeps the poses by the stated intrinsics: it can be solved again
    with open_log(workcell_log) as log:
        read = read_pairs(log, solved.rig)
    for pair, measured in solved.pairs.items():
        np.testing.assert_array_equal(measured.B, read[pair].B)


@pytest.mark.filterwarnings("ignore:.*poses have no image")
@pytest.mark.slow
def test_two_sensors_with_one_camera_have_one_set_of_intrinsics(workcell_camera2: Path, tmp_path: Path) -> None:
    """The same images stand for two cameras that share intrinsics; one of another size is refused by name."""
    for name in ("left", "right"):
        (tmp_path / "cell" / name).mkdir(parents=True)
        for image in sorted((workcell_camera2 / "image").glob("*.png"))[::3]:
            shutil.copy(image, tmp_path / "cell" / name)
    shutil.copytree(workcell_camera2 / "pose", tmp_path / "cell" / "pose")
    shutil.copy(workcell_camera2 / "intrinsic_pars_file.yaml", tmp_path / "cell")
    one = "  camera2: {images: image, poses: pose, intrinsics: intrinsic_pars_file.yaml}\n"
    two = (
        "  left: {images: left, poses: pose, intrinsics: intrinsic_pars_file.yaml}\n"
        "  right: {images: right, poses: pose, intrinsics: {shared: left}}\n"
    )
    corners_of(tmp_path / "cell", WORKCELL.replace(one, two), tmp_path)
    refined = solve_log(tmp_path / "calibration.mcap").refined
    assert refined.intrinsics["left"].shared_with == ("right",)
    assert refined.intrinsics["left"].values == refined.intrinsics["right"].values
    for path in (tmp_path / "cell" / "right").iterdir():  # another lens, of 1.07 times the focal length
        image = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
        longer = cv2.getRotationMatrix2D((image.shape[1] / 2.0, image.shape[0] / 2.0), 0.0, 1.07)
        cv2.imwrite(str(path), cv2.warpAffine(image, longer, image.shape[::-1]))
    (tmp_path / "other").mkdir()
    corners_of(tmp_path / "cell", WORKCELL.replace(one, two), tmp_path / "other")
    other = solve_log(tmp_path / "other" / "calibration.mcap").judgement
    assert other.grounds[0] is rw.Ground.INTRINSICS_DOUBTED
    assert "they are those of left (shared), and right is another camera: give it its own" in other.reason
    for path in (tmp_path / "cell" / "right").iterdir():
        cv2.imwrite(str(path), np.zeros((480, 640), np.uint8))
    (tmp_path / "small").mkdir()
    with pytest.raises(LogError, match=r"right.*640 x 480"):
        corners_of(tmp_path / "cell", WORKCELL.replace(one, two), tmp_path / "small")


def test_images_of_two_cameras_in_one_folder_are_not_to_be_used(workcell_camera2: Path, tmp_path: Path) -> None:
    """Some images are as from another place: their boards agreed with no turn, and were ambiguous, without a word."""
    shutil.copytree(workcell_camera2, tmp_path / "cell")
    elsewhere = se3.expmap(np.array([[0.3, 1.2, -0.5, 0.4, -0.2, 0.3]]))[0]
    for path in sorted((tmp_path / "cell" / "pose").iterdir())[:14]:
        np.savetxt(path, elsewhere @ np.loadtxt(path))
    corners_of(tmp_path / "cell", WORKCELL, tmp_path)
    solved = solve_log(tmp_path / "calibration.mcap")
    assert solved.judgement.verdict is rw.Verdict.DO_NOT_USE
    assert set(solved.judgement.grounds) <= {rw.Ground.MOVED, rw.Ground.CONTRADICTED}
    assert solved.log.detection.tracks[0].removed == {}
    assert solved.log.agreement == {rw.Pair("board", "camera2"): (22, 34)}


def test_measurements_without_corners_beside_others_are_counted(workcell_log: Path) -> None:
    with open_log(workcell_log) as opened:
        log = CleanedLog.read(opened, None)
    (pair,) = log.pairs
    first = min(stamp for _, _, stamp in log.corners.detections)
    rest = {key: one for key, one in log.corners.detections.items() if key[2] != first}

    def calibrated(detections: Mapping[tuple[str, str, int], DetectionRecord]) -> rw.Calibration:
        corners = replace(log.corners, detections=detections)
        of_poses = log.problem_of(log.pairs)
        problem = corners.in_problem(of_poses, log.pairs, log.cameras)
        return rw.calibrate(problem, log.options(), recording=log.recording(log.pairs, of_poses))

    some = calibrated(rest)
    assert some.refined is not None
    assert some.refined.intrinsics
    (said,) = (choice for choice in some.choices if choice.what == "measurements without corners")
    assert said.chosen.startswith(f"1 of {pair} ")
    none = calibrated({})
    assert none.refined is not None
    assert not none.refined.intrinsics


def test_intrinsics_of_half_the_resolution_are_replaced_by_what_the_images_tell(
    workcell_camera2: Path, tmp_path: Path
) -> None:
    """By the stated ones the boards' poses leave directions free; the corners of planes alone start the refinement."""
    folder = tmp_path / "cell"
    (folder / "image").mkdir(parents=True)
    (folder / "pose").symlink_to(workcell_camera2 / "pose")
    for image in sorted((workcell_camera2 / "image").glob("*.png"))[::2]:
        (folder / "image" / image.name).symlink_to(image)
    half = "{K: [685.5, 685.5, 480, 270], size: [1920, 1080], stated: calibration}"
    with pytest.warns(LogWarning, match="poses have no image"):
        corners_of(folder, WORKCELL.replace("intrinsic_pars_file.yaml", half), tmp_path)
    solved = solve_log(tmp_path / "calibration.mcap")
    assert solved.judgement.grounds[0] is rw.Ground.INTRINSICS_ESTIMATED
    assert solved.judgement.verdict is rw.Verdict.CARE
    assert "like those of images of half the resolution" in solved.judgement.reason
    assert solved.refined.intrinsics["camera2"].values[0] == pytest.approx(1371.0, abs=20.0)
    np.testing.assert_allclose(solved.refined.Y["camera2"].translation(), [1.7666, 2.0622, 1.1559], atol=0.02)
    (choice,) = (one for one in solved.calibration.choices if one.what == "intrinsics of camera2")
    assert "do not fit the corners" in choice.evidence


def test_nominal_intrinsics_of_other_people(circles_log: Path) -> None:
    """With f, c and the spacing as stated the corners of images that are left out are predicted to 4.6 mm."""
    observations = read_corners(circles_log)
    options = rw.CornerOptions(stated="nominal", carrier_noise="exact", size_share=0.03, outliers=False)
    found = rw.calibrate_corners(observations, options)
    camera = found.refined.intrinsics["camera"].camera
    assert camera.K[0, 0] == pytest.approx(530.0, abs=20.0)
    assert found.refined.shapes["grid"][0] == pytest.approx(-0.02, abs=0.01)
    assert held_out_errors(found.refined)["camera"].rms_mm < 0.7 * 4.6


@pytest.mark.slow
def test_the_log_road_chooses_what_predicts_left_out_images_of_other_people(circles_log: Path) -> None:
    """Freeing the errors of A predicts them to 10 mm, A as exact to 2; and the arm's errors are named."""
    solved = solve_log(circles_log)
    reprojection = solved.refined.reprojection
    assert reprojection is not None
    assert reprojection.carrier_poses == "exact"
    held_out = reprojection.sensors["camera"].held_out_mm
    assert held_out is not None
    assert held_out == pytest.approx(min(one.held_out_mm for one in reprojection.tried), rel=1e-12)
    assert held_out <= 1.91
    grounds = rw.Ground.NO_SIZE_FITS, rw.Ground.INTRINSICS_ESTIMATED, rw.Ground.SYSTEMATIC
    assert solved.judgement.grounds == grounds


def test_velocities_are_those_of_the_path_where_it_moves() -> None:
    rng = np.random.default_rng(0)
    stamps = np.arange(400) * 10_000_000
    twist = np.array([0.3, -0.2, 0.5, 0.1, 0.2, -0.1])
    noise = se3.expmap(rng.normal(scale=1e-5, size=(400, 6)))
    moving = CarrierMotion(Trajectory.of(stamps, se3.expmap(stamps[:, None] * 1e-9 * twist) @ noise), None)
    at = np.array([1_234_000_000, 2_000_000_000])
    assert moving.velocities(at) == pytest.approx(np.tile(twist, (2, 1)), abs=1e-3)
    still = CarrierMotion(Trajectory.of(stamps, noise), None)
    assert still.velocities(at) == pytest.approx(np.zeros((2, 6)), abs=0.0)
    stations = CarrierMotion(Trajectory.of(100 * stamps, moving.trajectory.T), None)
    assert stations.velocities(100 * at) is None


def test_a_log_that_no_stage_wrote_has_no_corners(workcell_camera2: Path, tmp_path: Path) -> None:
    write_folder_log(workcell_camera2, parse_rig(WORKCELL, "rig.yaml"), tmp_path / "raw.mcap")
    with pytest.raises(LogError, match=r"raw\.mcap"):
        read_corners(tmp_path / "raw.mcap")
