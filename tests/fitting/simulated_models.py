"""A model of a simulated cell's corners, and a point near its truth."""

from __future__ import annotations

import numpy as np
from rwhec_factors import se3
from simulated_cells import Cell

from gtsam_rwhec.fitting.corner_model import Model, Point
from gtsam_rwhec.fitting.corner_residuals import stacks_of
from gtsam_rwhec.fitting.stated_intrinsics import prior_of

A_NOISE = np.repeat([1e-3, 5e-4], 3)
CORNER_PX = 0.1


def model_and_point(small: Cell, *, about: str = "targetcarrier", exact: bool = False) -> tuple[Model, Point]:
    stacks, A = stacks_of(small.observations)
    cameras = small.observations.cameras
    names = small.observations.sensors
    model = Model(
        stacks, A, None if exact else A_NOISE, about, {name: name for name in names},  # type: ignore[arg-type]
        {name: prior_of(cameras[name], "nominal") for name in names}, {"board": np.full(4, 1e-3)}, CORNER_PX,
        tuple(stack.known.astype(float) for stack in stacks), bias_px={"board": 0.0},
    )  # fmt: skip
    rng = np.random.default_rng(7)
    moved = A if exact else A @ se3.expmap(rng.normal(size=(len(A), 6)) * A_NOISE)
    X, Y = small.near(rng, 1e-3)
    cameras_at = {name: cameras[name].parameters * (1.0 + 1e-3) for name in names}
    return model, Point(X, Y, moved, cameras_at, {"board": np.full(4, 5e-4)})
