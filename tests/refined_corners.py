"""A refinement from corners in numbers, of a small simulated cell."""

from __future__ import annotations

import sys
import warnings
from functools import cache

from places import REPOSITORY

import gtsam_rwhec as rw
from gtsam_rwhec.fitting.corners_as_refined import as_refined, intrinsics_of, numbers_of
from gtsam_rwhec.fitting.held_out import held_out_errors
from gtsam_rwhec.fitting.refined import Refined
from gtsam_rwhec.fitting.reprojection_record import TriedModel

sys.path.insert(0, str(REPOSITORY / "tests" / "fitting"))
from simulated_cells import Cell, cell

TRIED = (
    TriedModel("A's noise estimated and sizes as stated", 0.612, 0.318, True),
    TriedModel("A as exact and sizes as stated", 0.733, 0.402, False),
)


@cache
def two_cameras() -> tuple[Cell, rw.CornersRefined, Refined]:
    """Two cameras with nominal intrinsics, a bent board of another size than stated."""
    given = cell(5, images=24, stated="nominal", carrier=(5e-4, 2e-4))
    problem = given.observations.poses()
    problem.scale = "per_target"
    with warnings.catch_warnings(action="ignore", category=rw.errors.RwhecWarning):
        base = rw.refine(problem, rw.solve(problem), rw.RefineOptions(noise="estimate"))
    options = rw.CornerOptions(size_share=0.05, warp_m=1e-3)
    corners = rw.refine_corners(given.observations, base.X, base.Y, options)
    held_out = held_out_errors(corners, folds=2)
    intrinsics = intrinsics_of(corners, dict.fromkeys(corners.Y, "nominal"))
    found = numbers_of(given.observations, corners, options, held_out, TRIED)
    return given, corners, as_refined(base, corners, found, intrinsics)
