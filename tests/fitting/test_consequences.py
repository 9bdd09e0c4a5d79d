"""What intrinsics that are kept, and errors of A, would do to the extrinsics: against doing it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from rwhec_factors import se3
from simulated_cells import cell

import gtsam_rwhec as rw
from gtsam_rwhec.fitting.corner_graph import CornerGraph
from gtsam_rwhec.fitting.corners_as_refined import OF_CARRIERS, consequences_of
from gtsam_rwhec.fitting.pose_graph import optimise
from gtsam_rwhec.fitting.stated_intrinsics import CameraPrior

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
        errors.append(se3.logmap((se3.inverse(refined.Y["cam_0"].matrix()) @ given.Y["cam_0"])[None])[0][:3])
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
