"""Noise of A that passes for motion determines no frame."""

from __future__ import annotations

import numpy as np
import pytest
from placements import Placement
from simulated_cells import Cell, cell

import gtsam_rwhec as rw
from gtsam_rwhec.errors import UnderdeterminedError
from gtsam_rwhec.fitting.corner_checks import GROWS, farthest, grows_by_noise

NOISE = (1e-3, 5e-4)


def refined(given: Cell, options: rw.CornerOptions) -> rw.CornersRefined:
    X, Y = given.near(np.random.default_rng(9))
    return rw.refine_corners(given.observations, X, Y, options)


@pytest.mark.parametrize("stated", ["calibration", "exact"])
def test_boards_that_face_the_camera_straight_determine_no_place_along_its_axis(stated: str) -> None:
    # they turn about the camera's axis only; measured, about axes that are a milliradian apart
    given = cell(0, images=12, facing=Placement(tilt=0.0), carrier=NOISE)
    with pytest.raises(
        UnderdeterminedError, match=r"pose of board, cam_0, cam_1: .* noise of A .* turn about two axes"
    ):
        refined(given, rw.CornerOptions(stated=stated))  # type: ignore[arg-type]


def test_tilts_of_more_than_the_noise_determine_it() -> None:
    given = cell(0, images=12, facing=Placement(tilt=0.01), carrier=NOISE)
    result = refined(given, rw.CornerOptions(stated="calibration"))
    model = result.graph.model
    grows = grows_by_noise(model, result.point, result.noise, result.joint, result.slots, farthest(model, result.point))
    assert sorted(grows) == ["board", "cam_0", "cam_1"]
    assert max(grows.values()) < 0.5 * (1.0 + GROWS)


def test_frames_with_small_deviations_are_not_asked() -> None:
    result = refined(cell(0, images=12, carrier=NOISE), rw.CornerOptions(stated="exact"))
    model = result.graph.model
    assert not grows_by_noise(model, result.point, result.noise, result.joint, result.slots, 1.5)
