"""Errors of corners: those that stay in the refinement are those of its optimum."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from refined_corners import two_cameras

from gtsam_rwhec.cameras.camera import Camera
from gtsam_rwhec.fitting.corner_residuals import pixel_errors
from gtsam_rwhec.fitting.reprojection_record import BoardShape, Reprojection
from gtsam_rwhec.results.image_errors import CornerErrors, SeenView, board_of, errors_at_optimum


def views_of(sensor: str) -> list[SeenView]:
    given, _, refined = two_cameras()
    view = given.observations.views["board", sensor]
    corners = board_of(refined, "board", given.observations.corners["board"])
    inverse = np.linalg.inv(refined.Y[sensor].matrix())
    X = refined.X["board"].matrix()
    seen = enumerate(zip(view.A, view.pixels, strict=True))
    return [SeenView.of(pixels, corners, inverse @ A, X, i) for i, (A, pixels) in seen]


def at_optimum(camera: Camera, view: SeenView, found: Reprojection) -> CornerErrors:
    errors = errors_at_optimum(camera, view, found)
    assert errors is not None
    return errors


def test_errors_are_those_of_the_optimum_where_A_is_a_variable() -> None:
    _, corners, refined = two_cameras()
    assert refined.reprojection is not None
    for stack in corners.graph.model.stacks:
        sensor = stack.sensor
        camera = refined.intrinsics[sensor].camera
        found = [at_optimum(camera, view, refined.reprojection) for view in views_of(sensor)]
        assert [int(of.counts.sum()) for of in found] == [len(stack.points)] * len(stack.instant)
        errors_px = np.concatenate([of.px for of in found])
        camera = corners.intrinsics[sensor].camera
        X, Y = corners.X["board"].matrix(), corners.Y[sensor].matrix()
        optimum = pixel_errors(stack, X, Y, corners.point.A, camera.parameters, corners.shapes["board"])
        assert errors_px.shape == stack.pixels.reshape(-1, 2).shape
        apart = np.abs(errors_px) - np.abs(optimum.reshape(-1, 2))  # whichever is taken from the other
        assert np.abs(apart).max() < 0.05
        assert np.sqrt((errors_px**2).mean()) < 0.11
        measured = np.concatenate([view.pixels - camera.project(view.points) for view in views_of(sensor)])
        assert np.sqrt((measured**2).mean()) > 0.15  # with A as it was measured


def test_a_misread_corner_does_not_count() -> None:
    _, _, refined = two_cameras()
    assert refined.reprojection is not None
    views = views_of("cam_0")
    moved = views[3].pixels.copy()
    moved[7] += 40.0
    camera = refined.intrinsics["cam_0"].camera
    found = at_optimum(camera, views[3]._replace(pixels=moved), refined.reprojection)
    assert np.flatnonzero(~found.counts).tolist() == [7]
    assert np.abs(found.px[found.counts]).max() < 0.6


def test_a_board_is_as_it_was_found() -> None:
    given, corners, refined = two_cameras()
    flat = given.observations.corners["board"]
    found = board_of(refined, "board", flat)
    size, warp_x, warp_y = corners.shapes["board"]
    assert refined.reprojection is not None
    np.testing.assert_allclose(found[:, :2], flat[:, :2] * (1.0 + size), rtol=1e-12)
    assert np.ptp(found[:, 2]) > 0.2 * max(abs(warp_x), abs(warp_y))
    stiff = replace(refined, reprojection=replace(refined.reprojection, boards={"board": BoardShape((), (), ())}))
    np.testing.assert_allclose(board_of(stiff, "board", flat)[:, 2], 0.0)
    unknown = replace(refined, reprojection=None, scale=0.5)
    np.testing.assert_allclose(board_of(unknown, "board", flat), 2.0 * flat)
