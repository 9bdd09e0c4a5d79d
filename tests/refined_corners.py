"""A refinement from corners in numbers, of a small simulated cell."""

from __future__ import annotations

import sys
import warnings
from dataclasses import replace
from functools import cache

import numpy as np
from places import REPOSITORY

import gtsam_rwhec as rw
from gtsam_rwhec.refinement.refined import Refined
from gtsam_rwhec.refinement.reprojection_found import Reprojection, SensorReprojection, TriedModel
from gtsam_rwhec.reprojection.as_refined import as_refined, boards_of, intrinsics_of
from gtsam_rwhec.reprojection.consequences import consequences_of
from gtsam_rwhec.reprojection.held_out import held_out_errors
from gtsam_rwhec.reprojection.projection_uncertainty import by_region

sys.path.insert(0, str(REPOSITORY / "tests" / "reprojection"))
from simulated_cells import Cell, cell

TRIED = (
    TriedModel("A's noise estimated and sizes as stated", 0.612, 0.318, True),
    TriedModel("A as exact and sizes as stated", 0.733, 0.402, False),
)
#: Depth of the points whose projection is asked for, metres.
DISTANCE_M = 1.5


@cache
def two_cameras() -> tuple[Cell, rw.CornersRefined, Refined]:
    """Two cameras with nominal intrinsics, a bent board of another size than stated."""
    given = cell(5, images=24, stated="nominal", carrier=(5e-4, 2e-4))
    problem = given.observations.poses()
    problem.scale = "per_target"
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", rw.errors.RwhecWarning)
        base = rw.refine(problem, rw.solve(problem), rw.RefineOptions(noise="estimate"))
    options = rw.CornerOptions(size_share=0.05, warp_m=1e-3)
    corners = rw.refine_corners(given.observations, base.X, base.Y, options)
    held_out = held_out_errors(given.observations, corners, options, folds=2)
    intrinsics, sensors = {}, {}
    for name, of in intrinsics_of(corners, dict.fromkeys(corners.Y, "nominal")).items():
        together = corners.covariance(name, f"intrinsics:{name}")
        regions = by_region(of.camera, together, DISTANCE_M)
        intrinsics[name] = replace(of, projection_px=regions, projection_m=DISTANCE_M)
        view = given.observations.views["board", name]
        sensors[name] = SensorReprojection(
            len(view.A), int(view.known.sum()), 0, of.rms_px, held_out[name].rms_px, held_out[name].rms_mm,
            tuple(tuple(None if np.isnan(px) else float(px) for px in row) for row in held_out[name].regions_px),
        )  # fmt: skip
    noise = corners.noise
    found = Reprojection(
        0.1, noise.corner_px, "estimated", noise.carrier_rad, noise.carrier_m, sensors, boards_of(corners), TRIED,
        consequences_of(corners),
    )  # fmt: skip
    return given, corners, as_refined(base, corners, found, intrinsics)
