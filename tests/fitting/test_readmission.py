"""Images that their poses left out come back by their corners, and images of another board do not."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from simulated_cells import cell

import gtsam_rwhec as rw
from gtsam_rwhec.calibration.calibrate_options import Run
from gtsam_rwhec.calibration.clock_offsets import Answer
from gtsam_rwhec.calibration.from_corners import answered_by_corners
from gtsam_rwhec.files.progress import silent
from gtsam_rwhec.fitting.observations import Views
from gtsam_rwhec.fitting.readmission import agreeing_by_corners

PAIR = rw.Pair("board", "cam_0")


def test_good_images_come_back_and_a_turned_board_does_not() -> None:
    given = cell(3, images=30, carrier=(5e-4, 2e-4))
    view = given.observations.views[PAIR]
    pixels = view.pixels.copy()
    pixels[2] = pixels[2][::-1]
    every = replace(given.observations, views={**given.observations.views, PAIR: Views(view.A, pixels)})
    kept = {rw.Pair(*at): np.ones(len(of.A), dtype=bool) for at, of in every.views.items()}
    kept[PAIR][[2, 5, 6]] = False
    some = replace(every, views={at: of.selected(kept[rw.Pair(*at)]) for at, of in every.views.items()})
    refined = rw.refine_corners(some, given.X, given.Y)
    found = agreeing_by_corners(every, kept, refined)
    assert np.flatnonzero(~found[PAIR]).tolist() == [2]
    assert all(mask.all() for pair, mask in found.items() if pair != PAIR)


def test_an_image_at_another_pose_of_the_arm_stays_out() -> None:
    """Its corners fit each other, and not the arm's pose."""
    given = cell(4, images=30, carrier=(2e-4, 1e-4))
    view = given.observations.views[PAIR]
    A = view.A.copy()
    A[3] = A[4]
    every = replace(given.observations, views={**given.observations.views, PAIR: Views(A, view.pixels)})
    kept = {rw.Pair(*at): np.ones(len(of.A), dtype=bool) for at, of in every.views.items()}
    kept[PAIR][3] = False
    some = replace(every, views={at: of.selected(kept[rw.Pair(*at)]) for at, of in every.views.items()})
    found = agreeing_by_corners(every, kept, rw.refine_corners(some, given.X, given.Y))
    assert not found[PAIR][3]


def test_calibrate_takes_them_back_too() -> None:
    given, problem = cell(3, images=30, carrier=(5e-4, 2e-4)), rw.Problem()
    for (target, sensor), view in given.observations.views.items():
        board, camera = given.observations.corners[target], given.observations.cameras[sensor]
        problem.add_corners(target, sensor, view.A, view.pixels, board, camera)
    base = rw.refine(problem, rw.solve(problem), rw.RefineOptions(noise="estimate", robust="gnc"))
    fewer = {pair: mask.copy() for pair, mask in base.inliers.items()}
    fewer[PAIR][[2, 5]] = False
    before = Answer(rw.solve(problem), fewer, replace(base, inliers=fewer))
    found = answered_by_corners(Run(problem, rw.CalibrateOptions(), silent), before)
    assert all(mask.all() for mask in found.inliers.values())
    assert found.refined is not None
    assert found.refined.reprojection is not None
    assert found.refined.reprojection.sensors["cam_0"].images == len(given.observations.views[PAIR].A)
    assert found.solution is not before.solution
