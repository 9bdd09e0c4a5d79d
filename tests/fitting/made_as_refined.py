"""A cell that was refined from poses, and from corners in the form of every refinement."""

from __future__ import annotations

from functools import cache

from simulated_cells import Cell, cell

import gtsam_rwhec as rw
from gtsam_rwhec.calibration.noise_choice import estimated
from gtsam_rwhec.fitting.corners_as_refined import as_refined, boards_of, intrinsics_of
from gtsam_rwhec.fitting.corners_refined import CornersRefined
from gtsam_rwhec.fitting.noise_in_data import NoiseInData
from gtsam_rwhec.fitting.refined import Refined
from gtsam_rwhec.fitting.reprojection_record import Reprojection
from gtsam_rwhec.geometry.blas_threads import one_blas_thread


@cache
@one_blas_thread()
def made() -> tuple[Cell, Refined, NoiseInData, CornersRefined, Refined]:
    """A cell, its refinement from poses with the noise, from corners, and the latter in the form of the former."""
    given = cell(5, images=30, stated="calibration", carrier=(5e-4, 2e-4), shape=(0.01, 0.0, 0.0))
    problem = given.observations.poses()
    problem.scale = "per_target"
    base, noise, _ = estimated(problem, rw.solve(problem), {}, rw.CalibrateOptions(), lambda _: None)
    assert noise.model is not None
    options = rw.CornerOptions(stated="calibration", size_share=0.05)
    corners = rw.refine_corners(given.observations, base.X, base.Y, options)
    intrinsics = intrinsics_of(corners, dict.fromkeys(corners.Y, "calibration"))
    found = Reprojection(0.1, 0.1, "estimated", 5e-4, 2e-4, {}, boards_of(corners), (), ())
    return given, base, noise.model, corners, as_refined(base, corners, found, intrinsics)
