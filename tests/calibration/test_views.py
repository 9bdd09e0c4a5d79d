"""Where sensors saw their targets: the median distance, in the mean direction, in true metres."""

from __future__ import annotations

import numpy as np
import pytest
from refinement_problems import rig

from gtsam_rwhec.calibration.point_uncertainty import views_of
from gtsam_rwhec.problem.problem import Problem


def seen(points: np.ndarray) -> Problem:
    poses = np.tile(np.eye(4), (len(points), 1, 1))
    poses[:, :3, 3] = points
    problem = Problem(scale="shared")
    problem.add("tag", "cam", np.tile(np.eye(4), (len(points), 1, 1)), poses)
    return problem


def test_the_median_distance_in_the_mean_direction_by_the_true_length() -> None:
    problem = seen(np.array([[0.0, 0.0, 1.0], [0.0, 0.0, 2.0], [0.0, 0.0, 9.0]]))
    view = views_of(problem, {}, 2.0)["cam"]
    assert view.point_m == pytest.approx((0.0, 0.0, 1.0))
    assert view.in_front
    without_last = {pair: np.array([True, True, False]) for pair in problem.pairs}
    assert views_of(problem, without_last, 1.0)["cam"].point_m == pytest.approx((0.0, 0.0, 1.5))


def test_all_around_there_is_no_direction_but_forward() -> None:
    view = views_of(seen(np.array([[2.0, 0.0, 0.0], [-2.0, 0.0, 0.0]])), {}, 1.0)["cam"]
    assert view.point_m == pytest.approx((0.0, 0.0, 2.0))
    assert not view.in_front


def test_motions_and_moments_have_no_view() -> None:
    assert views_of(rig(0, 2, odometry=5).problem, {}, 1.0) == {}
    assert views_of(rig(keep_measurements=False).problem, {}, 1.0) == {}
