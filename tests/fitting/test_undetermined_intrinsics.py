"""Intrinsics that the images do not tell are named as held by the prior; what kept ones do to the extrinsics."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from rwhec_factors import se3
from simulated_cells import CAMERA, UNDETERMINED, Cell, cell

import gtsam_rwhec as rw
from gtsam_rwhec.errors import UnderdeterminedError
from gtsam_rwhec.fitting.corner_graph import CornerGraph
from gtsam_rwhec.fitting.corners_as_refined import OF_CARRIERS, consequences_of
from gtsam_rwhec.fitting.fit_options import Stated
from gtsam_rwhec.fitting.pose_graph import optimise
from gtsam_rwhec.fitting.stated_intrinsics import CameraPrior, held_by_prior


def refined(given: Cell, stated: Stated) -> rw.CornersRefined:
    return given.refined(rw.CornerOptions(stated=stated, carrier_noise="exact"))


@pytest.mark.parametrize(
    ("where", "stated", "names"),
    [
        ("nearly fronto-parallel at one depth", "calibration", ("fx", "fy", "cx", "cy")),
        ("nearly fronto-parallel at one depth", "nominal", ("fx", "fy")),
        ("in a corner of the image", "calibration", ("cx", "cy")),
    ],
)
def test_what_the_images_do_not_tell_is_named_and_no_more_is_claimed(
    where: str, stated: Stated, names: tuple[str, ...]
) -> None:
    given = cell(4, images=16, facing=UNDETERMINED[where], stated=stated)
    result = refined(given, stated)
    for camera in result.intrinsics.values():
        assert set(names) <= set(camera.held_by_prior)
        deviations = np.sqrt(np.diagonal(camera.covariance))
        assert (deviations <= camera.prior.deviation * (1.0 + 1e-9)).all()
        said = ", ".join(camera.held_by_prior)
        assert any(f"The images do not tell {said} of" in words for words in result.findings)


@pytest.mark.parametrize(("where", "stated"), [("nearly fronto-parallel at one depth", "calibration"),
    ("nearly fronto-parallel at one depth", "nominal"), ("in a corner of the image", "calibration"),
])  # fmt: skip
def test_the_truth_is_where_the_covariance_says(where: str, stated: Stated) -> None:
    """Of 24 cameras at most one is outside 99.9 %: where f and the distance go together, the answer is not linear."""
    outside = 0
    for seed in range(12):
        result = refined(cell(seed, images=16, facing=UNDETERMINED[where], stated=stated), stated)
        for sensor, camera in result.intrinsics.items():
            off = CAMERA.parameters - camera.camera.parameters
            squared = off @ np.linalg.solve(camera.covariance, off)
            outside += squared > result.squared_radius(f"intrinsics:{sensor}", 0.999)
    assert outside <= 1


def test_images_at_all_tilts_and_places_tell_all() -> None:
    assert not any(camera.held_by_prior for camera in refined(cell(4, images=16), "nominal").intrinsics.values())


def test_a_carrier_that_only_translates_determines_no_pose() -> None:
    given = cell(1, images=1, cameras=1)
    start = given.observations.views["board", "cam_0"].A[0]
    moves = se3.expmap(np.pad(np.random.default_rng(0).normal(scale=0.05, size=(12, 3)), ((0, 0), (3, 0))))
    A = moves @ start
    seen = np.linalg.inv(given.Y["cam_0"]) @ A @ given.X["board"]
    points = given.observations.corners["board"] @ seen[:, :3, :3].transpose(0, 2, 1) + seen[:, None, :3, 3]
    pixels = CAMERA.with_parameters(CAMERA.parameters).pixels(points[..., :2] / points[..., 2:])
    observations = rw.Observations.of({"cam_0": CAMERA}, {"board": given.observations.corners["board"]},
                                      {("board", "cam_0"): (A, pixels)})  # fmt: skip
    for noise in ("exact", "estimate"):
        with pytest.raises(UnderdeterminedError, match=r"turn about two axes"):
            rw.refine_corners(observations, given.X, given.Y, rw.CornerOptions(carrier_noise=noise))  # type: ignore[arg-type]


def test_a_direction_that_only_the_prior_holds_names_its_parameters() -> None:
    # the images tell that fx = fy, and not how long: each has 0.71 of its prior's deviation
    prior = np.array([3.0, 3.0, 1.0])
    posterior = np.zeros((3, 3))
    posterior[:2, :2] = 0.48 * 9.0 * np.array([[1.0, 0.999], [0.999, 1.0]])
    posterior[2, 2] = 0.01
    assert (np.sqrt(np.diagonal(posterior)) < 0.7 * prior).all()
    assert held_by_prior(np.diag(1.0 / prior), posterior).tolist() == [True, True, False]


EXACT = rw.CornerOptions(stated="calibration", carrier_noise="exact")


def test_a_pixel_of_the_centre_moves_the_extrinsics_as_said() -> None:
    given = cell(1, images=25, cameras=1)
    refined = rw.refine_corners(given.observations, given.X, given.Y, EXACT)
    said = {(one.frame, one.cause): one for one in consequences_of(refined)}
    kept = refined.intrinsics["cam_0"].camera.parameters + np.eye(8)[2]
    model = refined.graph.model
    held = replace(model, camera_priors={"cam_0": CameraPrior(kept, np.full(8, 1e-7))})
    graph = CornerGraph(held, replace(refined.point, cameras={"cam_0": kept}))
    moved = graph.point(optimise(graph.graph, graph.values(graph.start), 50).values)
    for name, before, after in (("cam_0", refined.Y, moved.Y), ("board", refined.X, moved.X)):
        xi = se3.logmap((se3.inverse(before[name].matrix()) @ after[name])[None])[0]
        one = said[name, "1 pixel of cam_0's cx"]
        assert np.degrees(np.linalg.norm(xi[:3])) == pytest.approx(one.rotation_deg, rel=0.05)
        assert 1e3 * np.linalg.norm(xi[3:]) == pytest.approx(one.translation_mm, rel=0.05, abs=1e-3)


def test_errors_of_a_carrier_move_the_extrinsics_as_said() -> None:
    errors = []
    carrier = float(np.radians(0.1))
    for seed in range(20):
        given = cell(seed, images=15, cameras=1, carrier=(carrier, 0.0), corner_px=1e-3)
        refined = rw.refine_corners(given.observations, given.X, given.Y, EXACT)
        errors.append(given.error(refined, "cam_0")[:3])
        if seed == 0:
            said = next(one for one in consequences_of(refined) if one.frame == "cam_0" and "A's noise" in one.cause)
    worst = np.sqrt(np.linalg.eigvalsh(np.cov(np.transpose(errors)))[-1])
    assert np.degrees(worst) == pytest.approx(said.rotation_deg, rel=0.6)


def test_every_frame_and_cause_is_there() -> None:
    given = cell(2, images=10)
    refined = rw.refine_corners(given.observations, given.X, given.Y, EXACT)
    found = consequences_of(refined)
    assert {one.frame for one in found} == {"board", "cam_0", "cam_1"}
    assert len(found) == 3 * (2 * 3 + 1)
    of_A = [str(one) for one in found if one.cause.startswith(OF_CARRIERS)]
    assert len(of_A) == 3
    assert all("(one standard deviation; A turns about the origin of the target carrier) would move" in s for s in of_A)
    assert all(one.rotation_deg >= 0.0 and one.translation_mm >= 0.0 for one in found)
