"""The logs of the made-up robot cell: they hold what the script beside them draws, and the truth is theirs."""

from __future__ import annotations

import importlib
import json
import sys
from collections import Counter
from collections.abc import Iterator
from types import ModuleType
from typing import Any

import cv2
import numpy as np
import pytest
from places import DATA

from gtsam_rwhec.cameras.camera import Camera
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.logs import ImageRecord, IntrinsicsRecord, TfBuffer, open_log
from gtsam_rwhec.rig import read_rig

CELL = DATA / "cell"
#: name of a log's rig file, of its truth, of its cameras' poses in it and of its targets'
LOGS = {
    "robot_cell": ("rig.yaml", "truth.json", "T_hand_camera", "T_base_target"),
    "eye_to_hand": ("eye_to_hand.yaml", "eye_to_hand_truth.json", "T_base_camera", "T_hand_target"),
}


@pytest.fixture(scope="module")
def make_cell() -> Iterator[ModuleType]:
    """The script ``data/make_cell.py``."""
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(DATA))
        yield importlib.import_module("make_cell")
        for name in [name for name in sys.modules if name.partition(".")[0] in ("make_cell", "cell_scene")]:
            del sys.modules[name]


def truth(log: str) -> dict[str, Any]:
    return json.loads((CELL / LOGS[log][1]).read_text(encoding="utf-8"))


def images(log: str, camera: str) -> list[ImageRecord]:
    topic = read_rig(CELL / LOGS[log][0]).sensors[camera].images
    assert topic is not None
    with open_log(CELL / f"{log}.mcap") as opened:
        return [record for record in opened.records([topic]) if isinstance(record, ImageRecord)]


def test_together_they_are_small() -> None:
    assert sum(path.stat().st_size for path in CELL.iterdir()) < 6e6


def test_the_robot_cell_is_a_foxglove_log() -> None:
    with open_log(CELL / "robot_cell.mcap") as log:
        assert [(topic.name, topic.schema, topic.encoding, topic.count) for topic in log.topics()] == [
            ("/cam_left/camera_info", "foxglove.CameraCalibration", "json", 1),
            ("/cam_left/image", "foxglove.CompressedImage", "json", 60),
            ("/cam_wide/camera_info", "foxglove.CameraCalibration", "json", 1),
            ("/cam_wide/image", "foxglove.CompressedImage", "json", 60),
            ("/tf", "foxglove.FrameTransforms", "json", 3100),
        ]


def test_the_other_is_a_ros_2_log() -> None:
    with open_log(CELL / "eye_to_hand.mcap") as log:
        assert [(topic.name, topic.schema, topic.encoding, topic.count) for topic in log.topics()] == [
            ("/cam_front/camera_info", "sensor_msgs/msg/CameraInfo", "cdr", 1),
            ("/cam_front/image/compressed", "sensor_msgs/msg/CompressedImage", "cdr", 25),
            ("/cam_side/camera_info", "sensor_msgs/msg/CameraInfo", "cdr", 1),
            ("/cam_side/image/compressed", "sensor_msgs/msg/CompressedImage", "cdr", 25),
            ("/tf", "tf2_msgs/msg/TFMessage", "cdr", 800),
            ("/tf_static", "tf2_msgs/msg/TFMessage", "cdr", 1),
        ]


def test_the_truth_is_that_of_the_scene(make_cell: ModuleType) -> None:
    made = make_cell.truth()
    assert set(made) == {names[1] for names in LOGS.values()}
    for log, (_, name, *_) in LOGS.items():
        stored = truth(log)
        assert stored.keys() == made[name].keys()
        for key in stored:
            if key == "poster":
                assert stored[key] == made[name][key]
                continue
            assert stored[key].keys() == made[name][key].keys()
            for part in stored[key]:
                np.testing.assert_allclose(stored[key][part], made[name][key][part], rtol=0.0, atol=1e-12)


@pytest.mark.parametrize("log", LOGS)
def test_names_and_stated_sizes_belong_to_the_truth(log: str) -> None:
    rig, true = read_rig(CELL / LOGS[log][0]), truth(log)
    cameras, targets = (set(true[name]) for name in LOGS[log][2:])
    assert set(rig.sensors) == cameras == set(true["time_offset_s"])
    assert set(rig.targets) == targets == set(true["scale"])
    for target in rig.target_list:
        assert target.length_m == pytest.approx(true["scale"][target.name] * true["length_m"][target.name], rel=1e-12)
    for camera in cameras:
        assert {image.frame for image in images(log, camera)} == {camera}
    with open_log(CELL / f"{log}.mcap") as opened:
        frames = TfBuffer(opened.records([topic.name for topic in opened.topics() if topic.name.startswith("/tf")]))
    assert {rig.carriers.sensors, rig.carriers.targets} <= set(frames.frames())


@pytest.mark.parametrize("log", LOGS)
def test_intrinsics_are_those_that_the_images_were_drawn_with(log: str, make_cell: ModuleType) -> None:
    with open_log(CELL / f"{log}.mcap") as opened:
        records = opened.records([topic.name for topic in opened.topics() if topic.name.endswith("camera_info")])
        found = {record.frame: record for record in records if isinstance(record, IntrinsicsRecord)}
    assert set(found) == set(truth(log)["time_offset_s"])
    points = np.random.default_rng(1).uniform([-0.4, -0.4, 1.0], [0.4, 0.4, 2.0], (50, 3))
    for name, record in found.items():
        lens = make_cell.cell_of(name).lenses[name]
        camera = Camera.of(record.width, record.height, record.model, record.K, record.D, record.topic)
        assert (camera.width, camera.height, camera.model) == (lens.width, lens.height, lens.model)
        np.testing.assert_allclose(camera.project(points), lens.project(points), atol=1e-6)


@pytest.mark.parametrize("log", LOGS)
def test_the_robots_poses_have_the_noise_that_the_rig_file_says(log: str, make_cell: ModuleType) -> None:
    rig = read_rig(CELL / LOGS[log][0])
    with open_log(CELL / f"{log}.mcap") as opened:
        tf = TfBuffer(opened.records([topic.name for topic in opened.topics() if topic.name.startswith("/tf")]))
    stamps = tf.stamps("base", "hand")
    stated, _ = tf.at("base", "hand", stamps)
    true = make_cell.cell_of(next(iter(rig.sensors))).hand((stamps - stamps[0]) / 1e9)
    error = np.linalg.inv(true) @ stated
    turned = np.stack([error[:, 2, 1], error[:, 0, 2], error[:, 1, 0]], axis=1)
    noise = rig.carriers.noise
    assert noise is not None
    # Standard deviations of 2400 numbers and more are known to 1.5 %.
    assert np.degrees(turned.std()) == pytest.approx(noise.rotation_deg, rel=0.06)
    assert 1e3 * error[:, :3, 3].std() == pytest.approx(noise.translation_mm, rel=0.06)


def corners_on(target: Any) -> dict[int, Array]:
    """By id, the corners (4, 3) of a rig file's tags in the target's frame, in OpenCV's order."""
    h = 0.5 * target.length_m
    return {target.id: np.array([[-h, h, 0.0], [h, h, 0.0], [h, -h, 0.0], [-h, -h, 0.0]])}


def found_tags(picture: np.ndarray) -> list[tuple[int, Array]]:
    """(id, corners (4, 2)) that OpenCV finds."""
    parameters = cv2.aruco.DetectorParameters()
    parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
    family = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)
    corners, ids, _ = cv2.aruco.ArucoDetector(family, parameters).detectMarkers(picture)
    return [] if ids is None else [(int(i), c[0]) for i, c in zip(ids.ravel(), corners, strict=True)]


@pytest.mark.parametrize(
    ("log", "camera"),
    [
        ("eye_to_hand", "cam_front"),
        pytest.param("robot_cell", "cam_wide", marks=pytest.mark.slow),
        pytest.param("robot_cell", "cam_left", marks=pytest.mark.slow),
        pytest.param("eye_to_hand", "cam_side", marks=pytest.mark.slow),
    ],
)
def test_targets_are_often_seen_where_the_truth_puts_them(log: str, camera: str, make_cell: ModuleType) -> None:
    cell, rig, true = make_cell.cell_of(camera), read_rig(CELL / LOGS[log][0]), truth(log)
    tags = {target.id: target for target in rig.target_list if hasattr(target, "id")}
    board = next((target for target in rig.target_list if target.name == "board"), None)
    found, wrong = Counter[str](), Counter[int]()
    errors: dict[str, list[float]] = {}
    for record in images(log, camera):
        picture = make_cell.decoded(record.data)
        t = (record.stamp_ns - make_cell.hand_cameras.START_NS) / 1e9 + true["time_offset_s"][camera]
        T_base_hand = cell.hand(np.array([t]))[0]
        Y = np.array(true[LOGS[log][2]][camera])
        T_camera_other = np.linalg.inv(T_base_hand @ Y) if log == "robot_cell" else np.linalg.inv(Y) @ T_base_hand
        T = {name: T_camera_other @ np.array(X) for name, X in true[LOGS[log][3]].items()}

        def off(name: str, corners: Array, seen: Array, T: dict[str, Array] = T) -> float:
            """Of corners in the target's frame from where they were seen: pixels, the mean."""
            points = corners / true["scale"][name] @ T[name][:3, :3].T + T[name][:3, 3]
            return float(np.linalg.norm(cell.lenses[camera].project(points) - seen, axis=1).mean())

        for number, seen in found_tags(picture):
            name = tags[number].name
            error = off(name, corners_on(tags[number])[number], seen)
            if error > 5.0:
                wrong[record.stamp_ns] += 1
                continue
            found[name] += 1
            errors.setdefault(name, []).append(error)
        if board is not None:
            seen, ids = board_corners(picture, board)
            if len(ids) >= 6:
                found["board"] += 1
                errors.setdefault("board", []).append(off("board", board.corners()[ids], seen))
    # What hides corners or blurs is in few images; OpenCV's corners of a blurred tag lie a quarter of a pixel outside.
    assert {name: float(np.median(of)) for name, of in errors.items() if np.median(of) > 0.45} == {}
    assert {name: found[name] for name in true["scale"] if found[name] < (25 if name == "board" else 20)} == {}
    poster = true.get("poster", {"camera": None})
    assert sorted(wrong.elements()) == (poster["stamps_ns"] if poster["camera"] == camera else [])


def board_corners(picture: np.ndarray, board: Any) -> tuple[Array, np.ndarray]:
    """Places (n, 2) and numbers (n,) of a ChArUco board's corners that OpenCV finds."""
    markers = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_5X5_100)
    size = (board.columns, board.rows)
    detector = cv2.aruco.CharucoDetector(cv2.aruco.CharucoBoard(size, board.square_m, board.marker_m, markers))
    corners, ids, _, _ = detector.detectBoard(picture)
    if ids is None:
        return np.zeros((0, 2)), np.zeros(0, dtype=int)
    return np.reshape(corners, (-1, 2)), np.ravel(ids)


@pytest.mark.parametrize(("camera", "number"), [("cam_wide", 34), ("cam_side", 17)])
def test_an_image_drawn_again_is_the_one_in_the_log(camera: str, number: int, make_cell: ModuleType) -> None:
    assert make_cell.main(["--check", camera, str(number)]) == 0


def test_another_image_is_told(make_cell: ModuleType, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(make_cell, "SEED", make_cell.SEED + 1)
    assert make_cell.main(["--check", "cam_side", "3"]) == 1


def test_the_robot_turns_about_all_axes_while_each_target_is_seen(make_cell: ModuleType) -> None:
    """No axis is left out: the smallest standard deviation of the orientations, over axes, is above ten degrees."""
    for camera in ("cam_left", "cam_front"):
        cell = make_cell.cell_of(camera)
        T = cell.hand(cell.times(camera))
        relative = T[0, :3, :3].T @ T[:, :3, :3]
        turns = np.array([cv2.Rodrigues(R)[0].ravel() for R in relative])
        assert np.degrees(np.sqrt(np.linalg.eigvalsh(np.cov(turns.T))[0])) > 10.0
