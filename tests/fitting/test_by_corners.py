"""``rw.calibrate`` of a problem with corners: the answer is from them, and images' poses follow what it says."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from problems_of_corners import problem_of
from simulated_cells import CAMERA, Cell, cell

import gtsam_rwhec as rw
from gtsam_rwhec.calibration.calibrate_options import Run
from gtsam_rwhec.calibration.clock_offsets import Answer
from gtsam_rwhec.calibration.from_corners import MEASUREMENTS, with_better_poses
from gtsam_rwhec.errors import CountError, OptionError

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
    some.add("board", "cam_0", view.A[:3], problem.measurements("board", "cam_0").B[:3], 1e-3, 1e5)
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
