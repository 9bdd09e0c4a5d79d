"""The rig in space: what is drawn stands where the JSON has it, with the covariances' axes and the cameras' views."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from places import REPOSITORY
from refinement_problems import rig
from rwhec_factors import se3

import gtsam_rwhec as rw
from gtsam_rwhec.cameras.camera import Camera
from gtsam_rwhec.cameras.targets import AprilGrid, Charuco, Checkerboard, CircleGrid, Tag
from gtsam_rwhec.fitting.reprojection_record import BoardShape
from gtsam_rwhec.report.report_blocks import Drawing, Listing, Section
from gtsam_rwhec.report.report_page import read_shown
from gtsam_rwhec.report.scene_model import scene_of_rig
from gtsam_rwhec.report.scene_section import scene_section
from gtsam_rwhec.report.shown_result import ShownResult
from gtsam_rwhec.results.scene_evidence import SceneEvidence, drawn_board, rim_of, scene_of, standing_carrier
from gtsam_rwhec.simulate import Motion

CAMERA = Camera.of(640, 480, "radtan", [[500, 0, 320], [0, 510, 235], [0, 0, 1]], [-0.2, 0.05, 0, 0], "CAMERA")
FISHEYE = Camera.of(640, 480, "equidistant", [[280, 0, 320], [0, 280, 240], [0, 0, 1]], [0.01, 0, 0, 0], "FISHEYE")
TAG = Tag("tag_0", "tag36h11", 3, 0.1)


@pytest.fixture
def shown(folder: Path, calibration: rw.Calibration) -> ShownResult:
    """A calibration of two cameras and two targets, one of them a tag, the other a board."""
    board = Checkerboard("tag_1", 7, 5, 0.03)
    targets: dict[str, Any] = dict(zip(calibration.X, (TAG, board), strict=True))
    cameras = dict(zip(calibration.Y, (CAMERA, FISHEYE), strict=True))
    rows = rw.results.measured_rows(rig().problem, calibration)
    scene = scene_of(calibration, rows, ("hand", "base"), cameras, targets)
    evidence = rw.results.read_evidence(folder / "evidence.json").model_copy(update={"scene": scene})
    return ShownResult.of((folder / "result.json").read_bytes(), evidence)


def scene_evidence(shown: ShownResult) -> SceneEvidence:
    assert shown.evidence is not None
    assert shown.evidence.scene is not None
    return shown.evidence.scene


def drawing(section: Section) -> Drawing:
    (found,) = (block for block in section.blocks if isinstance(block, Drawing))
    return found


def traces(block: Drawing, name: str) -> list[dict[str, Any]]:
    return [dict(trace) for trace in block.traces if trace["name"] == name]


def places(trace: dict[str, Any]) -> np.ndarray:
    """The points (n, 3) of a trace; nan where a line is interrupted."""
    return np.array([trace[axis] for axis in "xyz"], dtype=float).T


def test_frames_stand_where_the_json_has_them(shown: ShownResult) -> None:
    block = drawing(scene_section(shown))
    scene = scene_evidence(shown)
    assert scene.standing == "targets"
    (targets,) = traces(block, "targets")
    assert np.abs(places(targets) - [row["translation_m"] for row in shown.tree["targets"]]).max() < 1e-9
    typical = np.eye(4)
    row = scene.poses[scene.typical]
    w, v = row[3], np.array(row[4:])
    typical[:3, :3] = np.eye(3) + 2.0 * w * se3.hat(v) + 2.0 * se3.hat(v) @ se3.hat(v)
    typical[:3, 3] = row[:3]
    (sensors,) = traces(block, "sensors")
    expected = [typical[:3, :3] @ one["translation_m"] + row[:3] for one in shown.tree["sensors"]]
    assert np.abs(places(sensors) - expected).max() < 1e-9
    model = scene_of_rig(shown, scene)
    (x_axes,) = traces(block, "x")
    drawn = places(x_axes).reshape(-1, 3, 3)  # start, end, gap
    first = next(i for i, frame in enumerate(model.frames) if frame.kind == "target")
    R = np.array(shown.tree["targets"][0]["rotation_matrix"])
    direction = drawn[first, 1] - drawn[first, 0]
    assert np.allclose(direction / np.linalg.norm(direction), R[:, 0], atol=1e-3)


def test_the_typical_pose_is_one_that_was_measured_and_the_path_has_all(shown: ShownResult) -> None:
    scene = scene_evidence(shown)
    problem = rig().problem
    every = problem.measurements(*problem.pairs[0]).A  # of all pairs, which are seen at the same instants
    inverse = se3.inverse(every)[:, :3, 3]
    assert scene.of == len(every) == len(scene.poses)
    apart = np.abs(np.array(scene.poses)[:, None, :3] - inverse[None]).max(axis=2).min(axis=1)
    assert apart.max() < 1e-12


def test_ellipsoids_have_the_axes_of_the_covariances(shown: ShownResult) -> None:
    assert shown.result is not None
    refined = shown.result.refined
    assert refined is not None
    scene = scene_of_rig(shown, scene_evidence(shown))
    block = drawing(scene_section(shown))
    (mesh,) = (dict(trace) for trace in block.traces if trace["meta"] == "ellipsoids")
    assert mesh["name"].endswith(f"×{scene.times:,.0f}")
    assert f"{scene.times:,.0f} times" in block.says
    drawn = places(mesh).reshape(-1, 42, 3)
    assert len(mesh["i"]) == 80 * len(drawn)
    names = [frame.name for frame in scene.frames if frame.name in scene.ellipsoids]
    for name, points in zip(names, drawn, strict=True):
        if name not in refined.X:
            continue
        R, t = refined.X[name].rotation().matrix(), refined.X[name].translation()
        covariance = R @ refined.covariance(name)[3:, 3:] @ R.T
        whitened = np.linalg.solve(np.linalg.cholesky(covariance), (points - t).T) / scene.times
        assert np.allclose((whitened**2).sum(axis=0), refined.squared_radius(3, 0.95), rtol=2e-3)


@pytest.mark.parametrize("camera", [CAMERA, FISHEYE], ids=["radtan", "equidistant"])
def test_the_corners_of_a_view_project_to_the_corners_of_the_image(camera: Camera) -> None:
    rim = rim_of(camera)
    corners = np.array([[0.0, 0.0], [640.0, 0.0], [640.0, 480.0], [0.0, 480.0]]) - 0.5
    assert np.allclose(np.linalg.norm(rim, axis=1), 1.0)
    assert np.abs(camera.project(rim[:: len(rim) // 4]) - corners).max() < 1e-6


def test_where_a_lens_has_no_ray_the_view_ends_before() -> None:
    folding = Camera.of(640, 480, "radtan", [[300, 0, 320], [0, 300, 240], [0, 0, 1]], [-0.6, 0, 0, 0], "it")
    pixels = folding.project(rim_of(folding))
    assert not folding.has_ray(np.array([[0.0, 0.0]])).any()
    assert np.isfinite(pixels).all()
    assert folding.inside(pixels).all()


def test_boards_have_their_true_sizes_and_their_warp() -> None:
    tag = drawn_board(TAG, scale=1.25)
    dark = np.concatenate([np.array(part) for part in tag.dark])
    assert np.ptp(dark, axis=0)[:2] == pytest.approx([0.08, 0.08])
    warped = BoardShape(("warp_x",), (0.004,), (1e-4,))
    board = Checkerboard("board", 7, 5, 0.03)
    flat, bent = (np.concatenate([np.array(p) for p in drawn_board(board, shape=s).dark]) for s in (None, warped))
    reach = np.linalg.norm(board.corners(), axis=1).max()
    assert np.abs(bent[:, 2] - 0.004 * (flat[:, 0] / reach) ** 2).max() < 2e-6
    assert len(drawn_board(board).dark) == 24  # of 8 x 6 squares
    for other in (Charuco("c", "aruco_5x5_100", 7, 5, 0.04, 0.03), AprilGrid("a", "tag36h11", 6, 6, 0.08, 0.3)):
        drawn = np.concatenate([np.array(part) for part in drawn_board(other).dark])
        assert np.abs(drawn[:, :2]).max() >= np.abs(other.corners()[:, :2]).max()
    assert len(drawn_board(CircleGrid("g", 10, 9, 0.02)).dark) == 90


def test_a_tag_is_drawn_as_it_is_printed() -> None:
    """Its modules are those of the picture that OpenCV prints: seen from above, x to the right and y up."""
    import cv2

    from gtsam_rwhec.detect.tags import dictionary

    picture = cv2.aruco.generateImageMarker(dictionary(TAG.family), TAG.id, 8)
    drawn = np.full((8, 8), 255)
    for part in drawn_board(TAG).dark:
        left, bottom, _ = (np.array(part).min(axis=0) / TAG.size_m + 0.5) * 8
        right, top, _ = (np.array(part).max(axis=0) / TAG.size_m + 0.5) * 8
        drawn[round(8 - top) : round(8 - bottom), round(left) : round(right)] = 0
    assert (drawn == picture).all()


def test_free_directions_are_drawn_where_nothing_is_known() -> None:
    problem = rig(motion=Motion("planar")).problem
    calibration = rw.calibrate(problem)
    evidence = rw.results.evidence_of(problem, calibration)
    shown = ShownResult.of(rw.results.result_file.result_json(calibration), evidence)
    section = scene_section(shown)
    block = drawing(section)
    free = [dict(trace) for trace in block.traces if trace["meta"] == "directions" and trace["name"] == "free"]
    assert free
    assert "leave free" in block.says
    assert calibration.refined is not None
    heights = [d for d in calibration.refined.free_directions if d.kind == "translation"]
    assert heights
    name, twist = next(iter(heights[0].frames.items()))
    assert name in calibration.X
    along = calibration.X[name].rotation().matrix() @ np.array(twist[3:])
    start, end = places(free[0])[:2]
    assert np.abs(np.cross(end - start, along)).max() < 1e-3 * np.linalg.norm(end - start) * np.linalg.norm(along)
    (said,) = (block for block in section.blocks if isinstance(block, Listing))
    assert any(str(heights[0]) in str(item) for item in said.items)
    assert json.dumps(block.traces, allow_nan=False)


def test_a_result_alone_is_drawn_carrier_by_carrier(shown: ShownResult) -> None:
    alone = ShownResult(shown.tree, shown.result, None, shown.name)
    section = scene_section(alone)
    drawings = [block for block in section.blocks if isinstance(block, Drawing)]
    assert [block.name for block in drawings] == ["scene-targets", "scene-sensors"]
    assert any("no evidence.json" in str(block) for block in section.blocks)
    (sensors,) = traces(drawings[1], "sensors")
    assert np.abs(places(sensors) - [row["translation_m"] for row in shown.tree["sensors"]]).max() < 1e-9


@pytest.mark.parametrize("name", ["free", "corners"])
def test_results_of_all_kinds_are_drawn(name: str) -> None:
    section = scene_section(read_shown(REPOSITORY / "tests" / "golden" / f"result_{name}.json"))
    assert any(isinstance(block, Drawing) for block in section.blocks)


def test_the_carrier_that_stands_still_is_known_by_its_name() -> None:
    assert standing_carrier("hand", "base")[0] == "targets"
    assert standing_carrier("base", "hand")[0] == "sensors"
    assert standing_carrier("base_link", "map")[0] == "targets"
    assert standing_carrier("world", "arm/tool0")[0] == "sensors"
    assert standing_carrier(None, None) == (
        "targets",
        "the names of the carriers do not tell which of them stands still",
    )


def test_buttons_show_and_hide_the_groups_of_traces(shown: ShownResult) -> None:
    block = drawing(scene_section(shown))
    menus = {menu["buttons"][0]["label"]: menu for menu in block.layout["updatemenus"]}
    assert {"Views", "Path", "Ellipsoids", "Boards", "Names", "Slant"} <= menus.keys()
    for label, group in (("Views", "views"), ("Boards", "boards")):
        (button,) = menus[label]["buttons"]
        assert {block.traces[i]["meta"] for i in button["args"][1]} == {group}
        assert button["args2"][0] == {"visible": False}


def test_many_targets_are_points_and_the_scene_stays_small(tmp_path: Path) -> None:
    problem = rig(targets=100, sensors=2, number_of_measurements=4).problem
    rw.write_solution(rw.solve(problem), tmp_path / "result.json")
    section = scene_section(read_shown(tmp_path))
    block = next(block for block in section.blocks if isinstance(block, Drawing) and block.name == "scene-targets")
    assert len(json.dumps({"traces": block.traces, "layout": block.layout})) < 300_000
    (targets,) = traces(block, "targets")
    assert len(targets["x"]) == 100
    (names,) = (trace for trace in block.traces if trace["meta"] == "names")
    assert not names["visible"]
    (axes,) = traces(block, "x")
    assert len(axes["x"]) == 3  # of the carrier alone: start, end, gap
