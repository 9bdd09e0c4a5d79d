"""``rw.calibrate`` of a problem with corners: the answer is from them, also where nobody stated the intrinsics."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from problems_of_corners import problem_of
from rwhec_factors import se3
from simulated_cells import CAMERA, Cell, cell

import gtsam_rwhec as rw
from gtsam_rwhec.calibration.calibrate_options import Run
from gtsam_rwhec.calibration.clock_offsets import Answer
from gtsam_rwhec.calibration.from_corners import MEASUREMENTS, with_better_poses
from gtsam_rwhec.cameras.camera import Camera
from gtsam_rwhec.errors import CameraError, CountError, OptionError
from gtsam_rwhec.fitting.observations import Views

pytestmark = pytest.mark.filterwarnings("ignore::gtsam_rwhec.errors.WeightsWarning")


@cache
def made() -> tuple[Cell, rw.Problem, rw.Calibration]:
    """A cell whose nominal intrinsics are 12 pixels off, its problem, and its calibration."""
    off = np.zeros(4 + len(CAMERA.D))
    off[:4] = [15.0, 15.0, -12.0, 8.0]
    given = cell(3, cameras=1, images=16, stated_off=off, carrier=(5e-4, 2e-4))
    problem = problem_of(given.observations)
    return given, problem, rw.calibrate(problem)


def choice_of(calibration: rw.Calibration) -> rw.Choice:
    """What the answer is from."""
    (found,) = [choice for choice in calibration.choices if choice.what == MEASUREMENTS]
    return found


def test_the_answer_is_from_the_corners_where_every_measurement_has_them() -> None:
    given, problem, calibration = made()
    refined = calibration.refined
    assert refined is not None
    assert refined.reprojection is not None
    assert calibration.verdict is rw.Verdict.USE
    assert f"from {refined.reprojection.sensors['cam_0'].corners} corners" in choice_of(calibration).chosen
    assert "predicts images that were left out" in choice_of(calibration).evidence
    for name, truth in (given.X | given.Y).items():
        assert calibration.contains(name, truth, 0.999)
    assert calibration.solution is not None
    assert calibration.solution.certificate.is_certified
    assert problem.cameras["cam_0"] is given.observations.cameras["cam_0"]
    # poses by the stated intrinsics had more noise, which the certified answer no longer has
    before = rw.solve(problem)
    truth_m = given.Y["cam_0"][:3, 3]
    off_m, first_off_m = (
        np.linalg.norm(found["cam_0"].translation() - truth_m) for found in (calibration.solution.Y, before.Y)
    )
    assert off_m < 0.5 * first_off_m


def test_the_choice_is_an_option() -> None:
    given, problem, _ = made()
    calibration = rw.calibrate(problem, rw.CalibrateOptions(observations="poses"))
    assert calibration.refined is not None
    assert calibration.refined.reprojection is None
    assert not [choice for choice in calibration.choices if choice.what == MEASUREMENTS]
    poses = given.observations.poses()
    with pytest.raises(CountError, match="the problem has no corners"):
        rw.calibrate(poses, rw.CalibrateOptions(observations="corners"))
    fixed = problem + rw.Problem()
    fixed.fix("cam_0", given.Y["cam_0"])
    with pytest.raises(OptionError, match="does not hold the fixed pose of cam_0"):
        rw.calibrate(fixed, rw.CalibrateOptions(observations="corners"))
    with pytest.raises(OptionError, match=r"CalibrateOptions\.corners is a str; give a CornerOptions"):
        rw.CalibrateOptions(corners="nominal")  # type: ignore[arg-type]
    with pytest.raises(OptionError, match=r"observations='pixels' is not one of 'auto', 'corners', 'poses'"):
        rw.CalibrateOptions(observations="pixels")  # type: ignore[arg-type]


def test_where_some_measurements_are_poses_the_answer_is_from_poses_and_says_so() -> None:
    given, problem, _ = made()
    view = given.observations.views["board", "cam_0"]
    some = problem + rw.Problem()
    B = problem.measurements("board", "cam_0").B[:3] + np.eye(4, k=3) * 1e-6  # copies to the last digit count once
    some.add("board", "cam_0", view.A[:3], B, 1e-3, 1e5)
    calibration = rw.calibrate(some)
    assert calibration.refined is not None
    assert calibration.refined.reprojection is None
    assert "from the poses of targets" in choice_of(calibration).chosen
    assert "measurements without corners: board-cam_0 (3 of 19)" in choice_of(calibration).evidence


def test_a_problem_of_poses_has_no_other_ones() -> None:
    given, _, calibration = made()
    assert calibration.refined is not None
    answer = Answer(calibration.solution, {}, calibration.refined, calibration.noise)
    assert with_better_poses(Run(given.observations.poses(), rw.CalibrateOptions(), print), answer)[0] is None
    better, _ = with_better_poses(Run(problem_of(given.observations), rw.CalibrateOptions(), lambda _: None), answer)
    assert better is not None
    assert abs(better.cameras["cam_0"].K[0, 2] - given.cameras["cam_0"].K[0, 2]) < 4.0
    assert with_better_poses(better, answer)[0] is None


UNKNOWN = rw.CornerOptions(stated="unknown")
FISHEYE = Camera.of(
    1920,
    1080,
    "equidistant",
    [[700.0, 0.0, 950.0], [0.0, 700.0, 545.0], [0.0, 0.0, 1.0]],
    (-0.02, 6e-3, -4e-3, 8e-4),
    "cell",
)


def with_nothing_stated(given: Cell) -> Cell:
    """Only the size of images and the model of the lens are right."""
    K = [[1000.0, 0.0, 100.0], [0.0, 1000.0, 100.0], [0.0, 0.0, 1.0]]
    cameras = {
        name: Camera(camera.width, camera.height, camera.model, np.array(K), np.zeros(4))
        for name, camera in given.observations.cameras.items()
    }
    return replace(given, observations=replace(given.observations, cameras=cameras))


@pytest.mark.parametrize("camera", [CAMERA, FISHEYE], ids=["radtan", "fisheye"])
def test_corners_and_arm_alone_give_everything(camera: Camera) -> None:
    given = with_nothing_stated(cell(2, images=40, camera=camera, carrier=(5e-4, 3e-4)))
    found = rw.calibrate_corners(given.observations, UNKNOWN)
    assert found.solution.certificate.is_optimal
    assert str(found).startswith(str(found.refined))
    assert len(repr(found)) < 2000
    for name, T in (*given.X.items(), *given.Y.items()):
        pose = (found.refined.X | found.refined.Y)[name].matrix()
        xi = se3.logmap((se3.inverse(pose) @ T)[None])[0]
        assert xi @ np.linalg.solve(found.refined.covariance(name), xi) < 30.0
        assert np.degrees(np.linalg.norm(xi[:3])) < 0.5
    assert pytest.approx(camera.K, abs=6.0) == found.refined.intrinsics["cam_0"].camera.K
    assert not {"fx", "fy", "cx", "cy", "k1"} & set(found.refined.intrinsics["cam_0"].held_by_prior)


def test_images_that_disagree_are_left_out() -> None:
    given = cell(3, images=30, stated="nominal")
    view = given.observations.views["board", "cam_0"]
    pixels = view.pixels.copy()
    pixels[2] = pixels[2][::-1]  # the board turned by half a turn
    views = given.observations.views | {("board", "cam_0"): Views(view.A, pixels)}
    found = rw.calibrate_corners(replace(given.observations, views=views))
    assert not found.inliers[rw.Pair("board", "cam_0")][2]
    assert sum((~mask).sum() for mask in found.inliers.values()) <= 2
    xi = se3.logmap((se3.inverse(found.refined.Y["cam_0"].matrix()) @ given.Y["cam_0"])[None])[0]
    assert xi @ np.linalg.solve(found.refined.covariance("cam_0"), xi) < 30.0


def test_two_views_give_no_intrinsics() -> None:
    given = cell(4, images=2, cameras=1)
    with pytest.raises(CameraError, match="the intrinsics of cam_0 cannot be estimated from 2 views"):
        rw.calibrate_corners(given.observations, UNKNOWN)
