"""First rig files: what is named by looking at a log, what is marked for a person, and logs that give none."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import synthetic_logs as made
from hypothesis import given, settings
from hypothesis import strategies as st

from gtsam_rwhec.detect.tags import dictionary, tags_in_image
from gtsam_rwhec.errors import RigError
from gtsam_rwhec.logs import DetectionRecord, LogWriter, open_log
from gtsam_rwhec.rig import AprilGridTarget, CharucoTarget, Rig, parse_rig, propose_rig
from gtsam_rwhec.rig.guessed_targets import targets_seen
from gtsam_rwhec.rig.log_contents import ImageTopic, Tags, frame_name
from gtsam_rwhec.rig.section_types import is_name

STEP_NS = 100_000_000
POSES = 12


def pose(x: float, turn: float = 0.0) -> np.ndarray:
    T = np.eye(4)
    T[:2, :2] = [[math.cos(turn), -math.sin(turn)], [math.sin(turn), math.cos(turn)]]
    T[0, 3] = x
    return T


def printed(tags: Sequence[tuple[str, int, int]], border_bits: int = 1) -> np.ndarray:
    """An image (240, 320) of tags in a row: family, id, side in pixels."""
    image = np.full((240, 320), 230, np.uint8)
    left = 20
    for family, number, side in tags:
        tag = cv2.aruco.generateImageMarker(dictionary(family), number, side, borderBits=border_bits)
        image[60 : 60 + side, left : left + side] = tag
        left += side + 25
    return image


def png(image: np.ndarray) -> bytes:
    return cv2.imencode(".png", image)[1].tobytes()


class Scene:
    """Writes a log, in which things move, and opens it."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.out = LogWriter(folder / "run.mcap")
        self.others: list[made.Message] = []

    def moving(self, parent: str, child: str, topic: str = "/tf", reach: float = 0.5) -> Scene:
        for i in range(POSES):
            self.out.transforms(topic, i * STEP_NS + 1, [(parent, child, pose(reach * i / POSES, reach * i / POSES))])
        return self

    def static(self, parent: str, child: str) -> Scene:
        self.out.transforms("/tf_static", 1, [(parent, child, pose(0.1))])
        return self

    def images(self, topic: str, frame: str, data: bytes) -> Scene:
        for i in range(2):
            self.out.compressed_image(topic, i * STEP_NS + 1, frame, "png", data)
        return self

    def calibration(self, topic: str, frame: str) -> Scene:
        self.others.append(replace(made.camera_info(frame, 1, width=320, height=240), topic=topic))
        return self

    def stamped_poses(self, topic: str, frame: str) -> Scene:
        self.others += [made.pose_in_frame(10**9 * i, frame, pose(i), topic) for i in range(POSES)]
        return self

    def first(self) -> tuple[Rig, str, tuple[str, ...]]:
        self.out.__exit__(None, None, None)
        others = made.write(self.folder / "others.mcap", self.others)
        with open_log([self.folder / "run.mcap", others]) as log:
            text, notes = propose_rig(log, self.folder / "rig.yaml")
        return parse_rig(text, "rig.yaml"), text, notes


@pytest.fixture
def scene(tmp_path: Path) -> Scene:
    return Scene(tmp_path)


TAGS = png(printed([("tag36h11", 3, 80), ("tag36h11", 17, 80)]))
BLANK = png(np.full((240, 320), 200, np.uint8))


def test_cameras_on_a_hand(scene: Scene) -> None:
    scene.static("world", "base").moving("base", "link").moving("link", "hand").static("hand", "left_optical")
    scene.images("/left/image_raw/compressed", "left_optical", TAGS).calibration("/left/camera_info", "left_optical")
    scene.images("/right/image", "right_optical", BLANK).calibration("/right/calibration", "right_optical")
    rig, text, notes = scene.first()
    assert (rig.carriers.sensors, rig.carriers.targets) == ("hand", "base")
    assert rig.carriers.poses.tf == ("base", "hand")
    assert "hand carries the sensors, as tf has it" in text
    assert list(rig.sensors) == ["left", "right"]
    left, right = rig.sensors.values()
    assert (left.images, left.frame) == ("/left/image_raw/compressed", "left_optical")
    assert left.intrinsics is not None
    assert right.intrinsics is not None
    assert (left.intrinsics.topic, right.intrinsics.topic) == ("/left/camera_info", "/right/calibration")
    assert [target.ids for target in rig.target_list] == [(3,), (17,)]
    assert text.count("TODO measure; seen in 2 of 4 images") == 2
    assert "size_m: 0.1}" in text
    assert any("hand in base (chain of 3 links: 12 poses" in note for note in notes)
    assert "camera left: 2 images in /left/image_raw/compressed, 2 looked at" in notes


def test_fixed_cameras_and_a_tag_on_the_hand(scene: Scene) -> None:
    scene.moving("base", "hand").static("base", "cam").images("/cam/image", "cam", TAGS).calibration("/cam/info", "cam")
    rig, text, _ = scene.first()
    assert (rig.carriers.sensors, rig.carriers.targets) == ("base", "hand")
    assert rig.carriers.poses.parent_and_child == ("base", "hand")
    assert "base carries the sensors, as tf has it" in text
    assert list(rig.sensors) == ["cam"]


def test_where_the_cameras_are_is_not_known(scene: Scene) -> None:
    scene.moving("base", "hand").moving("base", "door", reach=0.2).images("/image_raw", "", TAGS)
    rig, text, notes = scene.first()
    assert (rig.carriers.sensors, rig.carriers.targets) == ("hand", "base")
    assert "TODO fixed camera and target on the hand: exchange the two names" in text
    assert any(note.startswith("moves too, not used: door in base") for note in notes)
    assert list(rig.sensors) == ["camera"]
    intrinsics = rig.sensors["camera"].intrinsics
    assert intrinsics is not None
    assert intrinsics.file == "camera.yaml"
    assert "TODO no topic has them" in text


def test_the_moving_frame_that_carries_a_camera_is_taken(scene: Scene) -> None:
    scene.moving("map", "a_cart").moving("base", "zz_hand", reach=0.1).static("zz_hand", "cam")
    scene.images("/cam/image", "cam", TAGS)
    rig, _, _ = scene.first()
    assert rig.carriers.sensors == "zz_hand"
    assert "cam" in rig.sensors


def test_names_that_are_taken(scene: Scene) -> None:
    scene.moving("base", "cam").images("/cam/image", "cam", TAGS).images("/other/cam/image", "f", TAGS)
    rig, _, _ = scene.first()
    assert rig.carriers.sensors == "cam"
    assert list(rig.sensors) == ["cam_2", "other_cam"]
    assert rig.sensors["cam_2"].frame is None


def test_poses_of_a_topic(scene: Scene) -> None:
    scene.stamped_poses("/robot/pose", "map").images("/cam/image", "cam", TAGS)
    rig, text, _ = scene.first()
    assert rig.carriers.poses.topic == "/robot/pose"
    assert rig.carriers.poses.parent_and_child == ("map", "robot_pose")
    assert rig.carriers.sensors == "robot_pose"
    assert "check the frames' names" in text.replace("\n  #", "")


def test_several_poses_in_a_message_are_of_no_carrier(scene: Scene) -> None:
    for i in range(POSES):
        scene.out.poses("/seen", i, "map", np.array([pose(i)]))
    with pytest.raises(RigError, match="no poses of anything that moves"):
        scene.images("/cam/image", "cam", BLANK).first()


def test_tf_is_taken_rather_than_a_topic(scene: Scene) -> None:
    scene.stamped_poses("/robot/pose", "map").moving("base", "hand").images("/cam/image", "cam", TAGS)
    rig, _, notes = scene.first()
    assert rig.carriers.poses.tf == ("base", "hand")
    assert any("robot_pose in map" in note for note in notes)


def test_a_driver(scene: Scene) -> None:
    records = [
        DetectionRecord(0, 0, "", "", "36h11", "5", T_camera_tag=pose(0.3), size_m=0.16),
        DetectionRecord(0, 0, "", "", "mine", "7", T_camera_tag=pose(0.3)),
        DetectionRecord(0, 0, "", "", "tag36h11", "7000", T_camera_tag=pose(0.3)),
        DetectionRecord(0, 0, "", "", "", "a board's name", T_camera_tag=pose(0.3)),
    ]
    for i in range(3):
        scene.out.detections("/front/tag_detections", i * STEP_NS + 1, "front_optical", records)
    scene.moving("base", "hand").calibration("/front/camera_info", "front_optical")
    rig, text, notes = scene.first()
    sensor = rig.sensors["front"]
    assert sensor.detections == "/front/tag_detections"
    assert sensor.intrinsics is not None
    assert sensor.intrinsics.topic == "/front/camera_info"
    assert [(t.name, t.family, t.ids, t.length_m) for t in rig.target_list] == [
        ("tag36h11_5", "tag36h11", (5,), 0.16), ("tag_7", "tag36h11", (7,), 0.1),
    ]  # fmt: skip
    assert "as its driver says" in text
    assert "TODO the family, which its driver calls 'mine'" in text
    assert "driver front: 12 detections in /front/tag_detections" in notes


def test_a_driver_without_poses_needs_intrinsics(scene: Scene) -> None:
    corners = np.array([[0.0, 0], [1, 0], [1, 1], [0, 1]])
    scene.out.detections("/tags", 1, "cam", [DetectionRecord(0, 0, "", "", "36h11", "5", corners_px=corners)])
    rig, text, _ = scene.moving("base", "hand").first()
    assert rig.sensors["cam"].intrinsics is not None
    assert "TODO no topic has them, and the driver gives no poses" in text


def test_of_a_driver_and_its_images_the_images(scene: Scene) -> None:
    scene.out.detections("/cam/tags", 1, "cam", [DetectionRecord(0, 0, "", "", "36h11", "5", T_camera_tag=pose(1.0))])
    rig, _, notes = scene.moving("base", "hand").images("/cam/image", "cam", TAGS).first()
    assert [sensor.images for sensor in rig.sensors.values()] == ["/cam/image"]
    assert any(note.startswith("not used: detections in /cam/tags") for note in notes)


def test_topics_that_are_left_out(scene: Scene) -> None:
    scene.moving("base", "hand").images("/cam/image", "cam", TAGS).images("/cam/image/compressed", "cam", TAGS)
    scene.images("/cam/depth/image", "cam", TAGS).images("/broken/image", "b", b"no image")
    rig, _, notes = scene.first()
    assert [sensor.images for sensor in rig.sensors.values()] == ["/cam/image"]
    left_out = [note for note in notes if note.startswith("not used")]
    assert any("/cam/image/compressed, of the same camera as /cam/image" in note for note in left_out)
    assert any("/cam/depth/image, depth" in note for note in left_out)
    assert any("/broken/image, " in note for note in left_out)


def test_no_tags_leave_an_example(scene: Scene) -> None:
    rig, text, notes = scene.moving("base", "hand").images("/cam/image", "cam", BLANK).first()
    assert list(rig.targets) == ["tag_0"]
    assert "TODO an example: no targets were seen" in text
    assert any("no target in 2 images" in note for note in notes)


def test_frames_that_a_rig_file_cannot_name(scene: Scene) -> None:
    scene.moving("base", "hand-1").moving("map", "cart", reach=0.2).images("/cam/image", "cam", TAGS)
    rig, _, notes = scene.first()
    assert rig.carriers.poses.tf == ("map", "cart")
    assert any("cannot name 'hand-1'" in note for note in notes)


def test_nothing_to_see(scene: Scene) -> None:
    scene.moving("base", "hand").calibration("/cam/info", "cam")
    with pytest.raises(RigError, match=r"run\.mcap, .*no images, clouds or detections.*topics: /cam/info \(foxg"):
        scene.first()


@pytest.mark.parametrize("still", ["nothing", "static", "standing"])
def test_nothing_moves(scene: Scene, still: str) -> None:
    scene.images("/cam/image", "cam", BLANK)
    if still == "static":
        scene.static("base", "hand")
    elif still == "standing":
        scene.moving("base", "hand", reach=0.001)
    with pytest.raises(RigError, match=r"no poses of anything that moves.*/cam/image \(foxglove.CompressedImage, 2"):
        scene.first()


def look(tags: dict[str, Tags], looked_at: int = 8) -> list[ImageTopic]:
    return [ImageTopic("/image", "", looked_at, looked_at=looked_at, tags=tags)]


def counts(ids: Iterable[int], number: int = 8) -> Counter[int]:
    return Counter(dict.fromkeys(ids, number))


@pytest.mark.parametrize(
    ("family", "ids", "columns", "rows", "named"),
    [
        ("aruco_5x5_1000", range(17), 7, 5, "aruco_5x5_50"),
        ("aruco_4x4_1000", range(100, 124), 7, 7, "aruco_4x4_250"),
        ("aruco_6x6_1000", range(6), 4, 3, "aruco_6x6_50"),
    ],
)
def test_markers_in_a_row_are_a_board(family: str, ids: range, columns: int, rows: int, named: str) -> None:
    (guess,), remarks = targets_seen(look({family: Tags(counts(ids))}), [])
    board = guess.section
    assert isinstance(board, CharucoTarget)
    assert (*board.squares, board.family, board.first_id) == (columns, rows, named, ids[0])
    assert board.target("board").ids == tuple(ids)
    assert "TODO count them, measure" in guess.remark
    assert remarks == []


def test_single_markers_are_tags() -> None:
    guesses, _ = targets_seen(look({"aruco_6x6_1000": Tags(counts([1, 30, 200]))}), [])
    assert [guess.name for guess in guesses] == ["aruco_6x6_250_1", "aruco_6x6_250_30", "aruco_6x6_250_200"]


def test_double_borders_are_an_aprilgrid() -> None:
    tags = Tags(single=counts(range(40), 1) + counts([50]), double=counts(range(4, 40)))
    guesses, _ = targets_seen(look({"tag36h11": tags}), [])
    grid = guesses[0].section
    assert isinstance(grid, AprilGridTarget)
    assert (*grid.tags, grid.first_id) == (6, 6, 4)
    assert [guess.name for guess in guesses[1:]] == [f"tag36h11_{i}" for i in (0, 1, 2, 3, 50)]


def test_tags_of_small_families_that_were_seen_once_are_left_out() -> None:
    tags = Tags(Counter({3: 8, 7: 2}))
    guesses, remarks = targets_seen(look({"tag16h5": tags}), [])
    assert [guess.name for guess in guesses] == ["tag16h5_3"]
    assert remarks == ["left out, seen too seldom to be sure: tag16h5 7"]


def test_each_place_is_one_tag() -> None:
    image = printed([("tag36h11", 3, 80), ("aruco_5x5_1000", 12, 70)])
    assert [(tag.family, tag.id) for tag in tags_in_image(image)] == [("tag36h11", 3), ("aruco_5x5_1000", 12)]
    # Alone, the family of few bits is read there too, which is why places are told apart.
    small = cv2.aruco.generateImageMarker(dictionary("aruco_5x5_1000"), 12, 21)
    crowded = np.full((240, 320), 230, np.uint8)
    crowded[100:121, 100:121] = small
    assert {tag.family for tag in tags_in_image(crowded)} <= {"aruco_5x5_1000"}


@pytest.mark.parametrize("border_bits", [1, 2])
@pytest.mark.parametrize("angle_deg", [0, 10, 20, 30])
def test_an_aprilgrids_tags_have_double_borders(border_bits: int, angle_deg: float) -> None:
    tags = [("tag36h11", i, 80) for i in (5, 100)]
    image = cv2.GaussianBlur(printed(tags, border_bits), (3, 3), 0)
    turn = cv2.getRotationMatrix2D((160, 120), angle_deg, 0.9)
    seen = tags_in_image(cv2.warpAffine(image, turn, (320, 240), borderValue=230))
    assert sorted((tag.id, tag.is_double) for tag in seen) == [(5, border_bits == 2), (100, border_bits == 2)]


@settings(deadline=None)
@given(st.text())
def test_any_text_becomes_a_frames_name(text: str) -> None:
    name = frame_name(text)
    assert not name or is_name(name)


ODD = st.text(st.sampled_from("/ab_1-. :#{'\n\x00é"), max_size=8) | st.sampled_from(
    ["f" * 200, "hand", "/" + "t/" * 600]
)


@settings(max_examples=15, deadline=None)
@given(topics=st.lists(ODD, min_size=3, max_size=3, unique=True), frames=st.lists(ODD, min_size=4, max_size=4))
def test_any_names(tmp_path_factory: pytest.TempPathFactory, topics: list[str], frames: list[str]) -> None:
    scene = Scene(tmp_path_factory.mktemp("any"))
    tiny = png(np.full((24, 24), 200, np.uint8))
    scene.moving(frames[0], frames[1]).images(topics[0], frames[2], tiny).images(topics[1], frames[3], tiny)
    scene.stamped_poses(topics[2], frames[0]).calibration("/info", frames[2])
    try:
        scene.first()
    except RigError as error:
        assert "topics: " in str(error)  # noqa: PT017
