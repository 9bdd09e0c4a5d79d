"""What was seen: detections over time, corners in cameras, the share of the image that has them, and their errors."""

from __future__ import annotations

import json
from collections import Counter
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import pytest
from problems_of_corners import problem_of
from refined_corners import two_cameras

import gtsam_rwhec as rw
from gtsam_rwhec.cameras.camera import Camera
from gtsam_rwhec.fitting.corner_residuals import pixel_errors
from gtsam_rwhec.fitting.reprojection_record import BoardShape, Reprojection
from gtsam_rwhec.problem.measurements import Pair
from gtsam_rwhec.results.detection_evidence import (
    MOST_LISTED,
    MOST_ROWS,
    PIECES,
    counts_of,
    removed_list,
    seen_in_problem,
    span_of,
    tracks_of,
)
from gtsam_rwhec.results.evidence import evidence_json
from gtsam_rwhec.results.image_errors import (
    CornerErrors,
    SeenView,
    board_of,
    cells_with_corners,
    errors_at_optimum,
    rated_views,
    seen_cameras,
    worst_views,
)

OFF_PX = 3.0


def views_of(sensor: str) -> list[SeenView]:
    """All images of a camera; number 7 was left out of the answer."""
    given, _, refined = two_cameras()
    view = given.observations.views["board", sensor]
    corners = board_of(refined, "board", given.observations.corners["board"])
    inverse, X = np.linalg.inv(refined.Y[sensor].matrix()), refined.X["board"].matrix()
    return [
        SeenView.of(pixels, corners, inverse @ A, X, i, "board", is_used=i != 7)
        for i, (A, pixels) in enumerate(zip(view.A, view.pixels, strict=True))
    ]


def test_cells_with_corners() -> None:
    pixels = np.array([[0.0, 0.0], [799.0, 599.0], [799.0, 599.0], [np.nan, 2.0], [-3.0, 300.0]])
    cells = cells_with_corners(pixels, (800, 600))
    assert cells.shape == (6, 8)
    assert (cells[0, 0], cells[5, 7], cells[3, 0], cells.sum()) == (1, 2, 1, 4)
    assert cells_with_corners(pixels, (600, 800)).shape == (8, 6)


def test_the_worst_images_are_those_that_are_far_off() -> None:
    _, _, refined = two_cameras()
    found = refined.reprojection
    assert found is not None
    cameras = {name: one.camera for name, one in refined.intrinsics.items()}
    views = views_of("cam_0")
    off = OFF_PX * np.where(np.arange(len(views[5].pixels))[:, None] % 2, 1.0, -1.0)
    views[5] = views[5]._replace(pixels=views[5].pixels + off)
    rated = rated_views({"cam_0": views}, cameras, found, lambda target, sensor: found.corner_px)
    worst = worst_views(rated, most=3)
    assert worst[0].view.stamp_ns == 5
    assert worst[0].rms_px == pytest.approx(OFF_PX, rel=0.2)
    assert worst[0].times_noise == pytest.approx(worst[0].rms_px / found.corner_px)
    assert [one.view.stamp_ns for one in worst if not one.view.is_used] == [7]
    (camera,) = seen_cameras(rated, cameras, found)
    assert camera.images == len(rated) - 1
    assert camera.at_optimum
    assert camera.corners == sum(map(sum, camera.cells))
    assert camera.share == np.mean(np.array(camera.cells) > 0)
    kept = np.column_stack([camera.x, camera.y])
    shown = np.concatenate([one.view.pixels for one in rated if one.view.is_used])
    assert np.abs(kept[:, None] - shown).max(axis=2).min(axis=1).max() < 0.006


def test_a_problem_with_corners_tells_where_they_are() -> None:
    given, _, refined = two_cameras()
    problem = problem_of(given.observations, scale="per_target")
    rows = {}
    for pair in problem.pairs:
        raw = problem.measurements(*pair)
        rows[pair] = rw.results.MeasuredRows(raw.A, raw.B, None, None, ("", "far off", *[""] * (len(raw.A) - 2)))
    seen = seen_in_problem(problem, refined, rows)
    assert [camera.sensor for camera in seen.cameras] == ["cam_0", "cam_1"]
    assert refined.reprojection is not None
    for camera in seen.cameras:
        assert camera.images == len(rows[Pair("board", camera.sensor)].reasons) - 1
        assert camera.rms_px == pytest.approx(refined.reprojection.sensors[camera.sensor].rms_px, rel=0.1)
    assert (seen.used, seen.removed) == (sum(camera.images for camera in seen.cameras), 2)
    assert {one.is_used for one in seen.worst} == {True, False}
    assert seen.worst[0].picture is None
    assert seen.no_pictures
    read = json.loads(evidence_json(rw.results.Evidence(seen=seen)))["seen"]
    assert read["cameras"][0]["corners"] == seen.cameras[0].corners


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
        assert [int(of.counts.sum()) for of in found] == [stack.points.shape[1]] * len(stack.instant)
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
    size, warp_x, warp_y, _ = corners.shapes["board"]
    assert refined.reprojection is not None
    np.testing.assert_allclose(found[:, :2], flat[:, :2] * (1.0 + size), rtol=1e-12)
    assert np.ptp(found[:, 2]) > 0.2 * max(abs(warp_x), abs(warp_y))
    stiff = replace(refined, reprojection=replace(refined.reprojection, boards={"board": BoardShape((), (), ())}))
    np.testing.assert_allclose(board_of(stiff, "board", flat)[:, 2], 0.0)
    unknown = replace(refined, reprojection=None, scale=0.5)
    np.testing.assert_allclose(board_of(unknown, "board", flat), 2.0 * flat)


class Marks(NamedTuple):
    stamps_ns: np.ndarray | None
    reasons: tuple[str, ...]


def stage(reason: str) -> str:
    return reason.split()[0]


def marks(number: int, bad: dict[int, str], *, first_ns: int | None = 0) -> Marks:
    stamps = None if first_ns is None else first_ns + 1_000_000_000 * np.arange(number)
    return Marks(stamps, tuple(bad.get(i, "") for i in range(number)))


def test_each_measurement_is_in_its_piece_of_time() -> None:
    pairs = {Pair("tag", "cam"): marks(5, {3: "late one"}), Pair("board", "cam"): marks(3, {}, first_ns=8_000_000_000)}
    assert span_of(pairs.values()) == (0, 10.0)
    tag, board = tracks_of(pairs, stage)
    assert (tag.target, tag.sensor, tag.used, tag.removed) == ("tag", "cam", 4, 1)
    assert tag.used_at == ((0, 1), (PIECES // 10, 1), (PIECES // 5, 1), (2 * PIECES // 5, 1))
    assert tag.removed_at == {"late": ((3 * PIECES // 10, 1),)}
    assert [at for at, _ in board.used_at] == [4 * PIECES // 5, 9 * PIECES // 10, PIECES - 1]


def test_without_stamps_the_order_counts() -> None:
    pairs = {Pair("tag", "cam"): marks(4, {1: "far"}, first_ns=None), Pair("board", "cam"): marks(2, {})}
    assert span_of(pairs.values()) == (0, None)
    tag, board = tracks_of(pairs, stage)
    assert tag.removed_at == {"far": ((PIECES // 4, 1),)}
    assert board.used_at == ((0, 1), (PIECES // 2, 1))
    (only,) = removed_list(pairs, lambda sensor, stamp: "no")
    assert (only.image, only.time_s, only.reason) == ("measurement 2", None, "far")


def test_many_pairs_are_one_row_a_sensor() -> None:
    names = [(f"t{i}", f"c{j}") for i in range(MOST_ROWS) for j in range(2)]
    pairs = {Pair(*name): marks(3, {0: "far"} if name[1] == "c1" else {}) for name in names}
    rows = tracks_of(pairs, stage)
    assert [(row.sensor, row.target, row.used, row.removed) for row in rows] == [
        ("c1", None, 2 * MOST_ROWS, MOST_ROWS),
        ("c0", None, 3 * MOST_ROWS, 0),
    ]
    assert sum(count for _, count in rows[1].used_at) == 3 * MOST_ROWS


def test_all_that_was_removed_is_counted_and_the_first_is_listed() -> None:
    number = MOST_LISTED + 50
    pairs = {Pair("tag", "cam"): marks(number, dict.fromkeys(range(number), "far off"))}
    (count,) = counts_of(((pair, Counter(one.reasons)) for pair, one in pairs.items()), stage)
    assert (count.stage, count.reason, count.count) == ("far", "far off", number)
    listed = removed_list(pairs, lambda sensor, stamp: f"{sensor}_{stamp // 1_000_000_000}.png")
    assert len(listed) == MOST_LISTED
    assert (listed[7].image, listed[7].time_s) == ("cam_7.png", 7.0)
