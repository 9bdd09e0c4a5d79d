"""Logs and rig files from which no calibration can be made, the whole way: what is refused, where, and what to do."""

from __future__ import annotations

import base64
import errno
import os
import re
import shutil
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import synthetic_logs as made
from synthetic_logs import BEGIN_NS, Message

import gtsam_rwhec as rw
from gtsam_rwhec.errors import (
    CameraError,
    FileFormatError,
    LogError,
    LogWarning,
    RigError,
    RwhecError,
    StampError,
    TransformError,
)
from gtsam_rwhec.logs import LogWriter, open_log
from gtsam_rwhec.pipeline.all_stages import calibrate_log, solve_into
from gtsam_rwhec.pipeline.cleaning_stage import clean_log
from gtsam_rwhec.pipeline.detection_stage import detect_log
from gtsam_rwhec.pipeline.log_contract import DETECTION_METADATA, RIG_METADATA

try:
    import resource
except ImportError:  # Windows
    resource = None  # type: ignore[assignment]

RECORDED = made.recording(4.0)
MOVING = [message for message in RECORDED if message.topic == "/tf"]
SEEN = [message for message in RECORDED if message.topic != "/tf"]
#: Cameras with images in place of a driver.
WITH_IMAGES = {
    camera: f"images: /{camera}/image\n    intrinsics: {{topic: /{camera}/camera_info}}" for camera in made.CAMERAS
}
#: What there is of a calibration, beside plots/.
WRITTEN = {
    "clean.mcap", "result.json", "static_tf.launch.py", "tf.yaml", "rig.urdf.xacro", "camchain.yaml",
}  # fmt: skip
TAG = f"{{type: tag, family: tag36h11, id: 0, size_m: {made.SIZE_M}}}"
ESTIMATED = "detections: /cam_1/tags\n    time_offset: estimate"


def calibrate(folder: Path, messages: Iterable[Message], **pieces: str) -> Any:
    """All stages, on messages as given; `pieces` of the rig file replaced."""
    log = made.write(folder / "raw.mcap", messages)
    return calibrate_log(log, made.rig(**pieces), folder / "out")


def refused(folder: Path, messages: Iterable[Message], kind: type[RwhecError], *words: str, **pieces: str) -> str:
    """That a calibration ends with this very class and says all `words`, and that no result is there; the message."""
    with pytest.raises(RwhecError) as caught:
        calibrate(folder, messages, **pieces)
    assert type(caught.value) is kind, repr(caught.value)
    for word in words:
        assert word in str(caught.value), f"{word!r} is not in: {caught.value}"
    left = {path.name for path in (folder / "out").rglob("*")}
    assert left <= {"detected.mcap"}  # a whole stage, from which to go on
    return str(caught.value)


def picture(family: int | None = None, number: int = 0) -> bytes:
    """A PNG, gray, or with a tag in the middle."""
    pixels = np.full((made.HEIGHT, made.WIDTH), 230, dtype=np.uint8)
    if family is not None:
        dictionary = cv2.aruco.getPredefinedDictionary(family)
        pixels[140:340, 220:420] = cv2.aruco.generateImageMarker(dictionary, number, 200)
    return bytes(cv2.imencode(".png", pixels)[1].tobytes())


def images(data: bytes, count: int = 6) -> list[Message]:
    """Of both cameras, with their intrinsics before them."""
    messages = [made.camera_info(camera) for camera in made.CAMERAS]
    for i in range(count):
        stamp = BEGIN_NS + i * 400_000_000
        for camera in made.CAMERAS:
            content = {
                "timestamp": {"sec": stamp // 10**9, "nsec": stamp % 10**9},
                "frame_id": camera,
                "data": base64.b64encode(data).decode(),
                "format": "png",
            }
            messages.append(Message(f"/{camera}/image", "foxglove.CompressedImage", content, stamp))
    return messages


def linked(message: Message, **names: str) -> Message:
    """A message of tf between other frames."""
    return replace(message, content={"transforms": [part | names for part in message.content["transforms"]]})


def restamped(messages: Iterable[Message], topics: str, stamp: Callable[[int], int]) -> list[Message]:
    """With the stamps of topics (a regular expression) changed."""
    return [m.stamped(stamp(m.stamp_ns)) if re.fullmatch(topics, m.topic) else m for m in messages]


def since_1970(stamp_ns: int) -> int:
    """What a clock that began at 0 when the camera was switched on has."""
    return stamp_ns - BEGIN_NS + 10**9


# Files


def test_what_is_no_log(tmp_path: Path) -> None:
    (tmp_path / "raw.mcap").write_bytes(b"#ROSBAG V2.0\n" + bytes(100))
    with pytest.raises(LogError, match=r"raw\.mcap.*(is not an MCAP|no MCAP)"):
        calibrate_log(tmp_path / "raw.mcap", made.rig(), tmp_path / "out")
    assert not (tmp_path / "out").exists()
    with pytest.raises(LogError, match=r"nowhere\.mcap"):
        calibrate_log(tmp_path / "nowhere.mcap", made.rig(), tmp_path / "out")


def test_a_log_that_breaks_off_gives_what_there_is(tmp_path: Path) -> None:
    whole = made.write(tmp_path / "whole.mcap", RECORDED, chunk_size=1 << 14)
    (tmp_path / "part.mcap").write_bytes(whole.read_bytes()[: whole.stat().st_size * 6 // 10])
    with pytest.warns(LogWarning, match=r"part\.mcap"):
        report = detect_log(tmp_path / "part.mcap", made.rig(), tmp_path / "detected.mcap")
    used = sum(track.used for track in report.tracks)
    assert 0.2 * 114 < used < 0.9 * 114


def test_encodings_that_are_not_known(tmp_path: Path) -> None:
    strange = [replace(m, encoding="flatbuffer", data=b"\0" * 40) if m.topic == "/cam_0/tags" else m for m in RECORDED]
    refused(tmp_path, strange, LogError, "/cam_0/tags", "flatbuffer")


def test_schemas_that_are_not_known(tmp_path: Path) -> None:
    strange = [replace(m, schema="acme.Tags") if m.topic == "/cam_0/tags" else m for m in RECORDED]
    refused(tmp_path, strange, LogError, "/cam_0/tags", "acme.Tags")


# Topics


def test_topics_that_are_not_there(tmp_path: Path) -> None:
    without = [m for m in RECORDED if m.topic != "/cam_0/tags"]
    there = "/cam_1/tags (gtsam_rwhec.TagDetections), /tf (foxglove.FrameTransforms)"
    refused(tmp_path, without, LogError, "raw.mcap has no topic /cam_0/tags", f"it has: {there}")
    refused(
        tmp_path, without + images(picture())[:1], LogError, "has no topic /cam_0/image", "/cam_0/camera_info", there,
        cam_0=WITH_IMAGES["cam_0"],
    )  # fmt: skip
    poses = "{topic: /pose, parent: base, child: hand}"
    refused(tmp_path, RECORDED, LogError, "has no topic /pose", "/cam_0/tags", there, poses=poses)
    refused(
        tmp_path, SEEN, LogError, "tf base to hand: the log has no transforms", "/cam_1/tags", "Record /tf and "
        "/tf_static too",
    )  # fmt: skip


def test_a_topic_of_something_else(tmp_path: Path) -> None:
    messages = images(picture())[:2] + RECORDED
    piece = WITH_IMAGES["cam_0"].replace("/cam_0/image", "/tf")
    refused(tmp_path, messages, LogError, "topic /tf has no images but PoseRecords", cam_0=piece)
    piece = "detections: /tf"
    refused(tmp_path, messages, LogError, "topic /tf has no detections but PoseRecords", cam_0=piece)


# Intrinsics


def test_no_intrinsics(tmp_path: Path) -> None:
    messages = [m for m in images(picture()) if m.topic != "/cam_0/camera_info"] + MOVING
    refused(
        tmp_path, messages, LogError, "sensor cam_0", "no topic /cam_0/camera_info",
        "Topics of intrinsics in it: /cam_1/camera_info", "/cam_0/image", "{file: ...}", **WITH_IMAGES,
    )  # fmt: skip
    broken = [replace(made.camera_info("cam_0"), data=b"{]"), *messages]
    with pytest.warns(LogWarning, match="/cam_0/camera_info"):
        refused(tmp_path, broken, CameraError, "/cam_0/camera_info has no message that can be read", **WITH_IMAGES)
    with pytest.raises(RigError, match=r"rig\.yaml, line 7: sensors\.cam_0: images without intrinsics"):
        made.rig(cam_0="images: /cam_0/image")


@pytest.mark.parametrize(
    ("changed", "words"),
    [
        ({"K": [0.0] * 9}, "K is all zeros: the camera was not calibrated"),
        ({"K": [0.004, 0, 320, 0, 0.004, 240, 0, 0, 1]}, "fx = 0.004 pixels for an image of 640 x 480 pixels"),
        ({"K": [-400.0, 0, 320, 0, 400, 240, 0, 0, 1]}, "fx = -400 pixels"),
        ({"K": [400.0, 0, 9e9, 0, 400, 240, 0, 0, 1]}, "cx = 9e+09 is far outside the image of 640 x 480"),
        ({"K": [float("nan"), 0, 320, 0, 400, 240, 0, 0, 1]}, "give a finite 3 x 3 matrix"),
        ({"width": 0}, "the image size is 0 x 480 pixels"),
        ({"D": [1e300] * 5}, "no lens has them"),
        ({"distortion_model": "acme"}, "distortion model 'acme' is not supported; supported are"),
    ],
)
def test_absurd_intrinsics(tmp_path: Path, changed: dict[str, Any], words: str) -> None:
    messages = [*images(picture())[1:], made.camera_info("cam_0", **changed), *MOVING]
    refused(tmp_path, messages, CameraError, "topic /cam_0/camera_info", words, **WITH_IMAGES)


def test_intrinsics_of_another_resolution(tmp_path: Path) -> None:
    larger = made.camera_info("cam_0", width=1280, height=960, K=[800.0, 0, 640, 0, 800, 480, 0, 0, 1])
    refused(
        tmp_path, [larger, *images(picture())[1:], *MOVING], LogError, "topic /cam_0/image", "none of the 6 images",
        f"{BEGIN_NS} ns: 640 x 480 pixels, but the intrinsics are for 1280 x 960", **WITH_IMAGES,
    )  # fmt: skip


# Stamps


def test_stamps_out_of_order(tmp_path: Path) -> None:
    def set_back(stamp_ns: int) -> int:
        return stamp_ns if stamp_ns < BEGIN_NS + 2 * 10**9 else stamp_ns - 3 * 10**9

    back = restamped(RECORDED, "/cam_1/tags", set_back)
    refused(
        tmp_path, back, StampError, "topic /cam_1/tags: stamps go back by 2.800 s at message 10", "1699999999020000000",
        "a clock was set, or two sources publish there; cut the log at that place",
    )  # fmt: skip
    back = restamped(RECORDED, "/tf", set_back)
    refused(tmp_path, back, StampError, "tf base to hand", "transforms of hand: stamps go back by 2.980 s at message ")
    back = MOVING + restamped(images(picture(), 11), ".*/image", set_back)
    refused(tmp_path, back, StampError, "topic /cam_0/image: stamps go back by 2.600 s at message 6", **WITH_IMAGES)


def test_stamps_that_go_back_step_by_step(tmp_path: Path) -> None:
    back = restamped(RECORDED, "/cam_1/tags", lambda stamp: 2 * BEGIN_NS + 4 * 10**9 - stamp)
    refused(tmp_path, back, StampError, "topic /cam_1/tags: stamps go back by 1.200 s at message 7", "cut the log")


@pytest.mark.parametrize(
    ("topics", "words"),
    [
        ("/tf", ("tf base to hand is from 1.000 to 5.000 s", "stamps of cam_0", "from 1700000000.200 to 17000")),
        ("/cam_./tags", ("tf base to hand is from 1700000000.000 to 1700000004.000 s", "cam_0", "1.200 to 4.800 s")),
        ("/cam_1/tags", ("tf base to hand is from 1700000000.000 to 1700000004.000 s", "cam_1", "1.220 to 4.820 s")),
    ],
)
def test_stamps_of_another_clock(tmp_path: Path, topics: str, words: tuple[str, ...]) -> None:
    messages = restamped(RECORDED, topics, since_1970)
    refused(tmp_path, messages, StampError, "no overlap in time", *words, "different clocks", "time offset")


def test_images_of_another_clock(tmp_path: Path) -> None:
    messages = MOVING + restamped(images(picture(cv2.aruco.DICT_APRILTAG_36h11)), ".*/image", since_1970)
    refused(tmp_path, messages, StampError, "no overlap in time", "cam_0", "1.000 to 3.000 s", **WITH_IMAGES)


def test_no_time_offset_joins_clocks_of_different_years(tmp_path: Path) -> None:
    messages = restamped(RECORDED, "/cam_1/tags", since_1970)
    words = "cam_1: no offset of up to 1 s", "1.220 to 4.820 s", "1700000000.000", "another clock?"
    refused(tmp_path, messages, StampError, *words, cam_1=ESTIMATED)


def test_no_overlap(tmp_path: Path) -> None:
    messages = restamped(RECORDED, "/tf", lambda stamp: stamp - 3600 * 10**9)
    words = "1699996400.000 to 1699996404.000 s", "cam_0", "1700000000.200 to 1700000003.800 s"
    refused(tmp_path, messages, StampError, "no overlap in time", *words)


@pytest.mark.parametrize(
    ("topics", "words"),
    [
        ("/tf", ("tf base to hand, transforms of hand: every stamp is 0 (201 messages)",)),
        ("/cam_1/tags", ("topic /cam_1/tags: every stamp is 0 (19 messages)",)),
    ],
)
def test_stamps_that_are_all_zero(tmp_path: Path, topics: str, words: tuple[str, ...]) -> None:
    messages = restamped(RECORDED, topics, lambda stamp: 0)
    refused(tmp_path, messages, StampError, *words, "does the driver fill header.stamp?")


def test_images_whose_stamps_are_all_zero(tmp_path: Path) -> None:
    messages = MOVING + restamped(images(picture()), ".*/image", lambda stamp: 0)
    refused(tmp_path, messages, StampError, "topic /cam_0/image: every stamp is 0 (6 messages)", **WITH_IMAGES)


# Transforms


def test_transforms_in_a_loop(tmp_path: Path) -> None:
    back = [linked(m, parent_frame_id="hand", child_frame_id="base") for m in MOVING]
    words = "raw.mcap, tf base to hand", "go round in a loop: base -> hand -> base"
    refused(tmp_path, RECORDED + back, TransformError, *words)
    longer = [linked(m, parent_frame_id="hand", child_frame_id="tool") for m in MOVING]
    longer += [linked(m, parent_frame_id="tool", child_frame_id="base") for m in MOVING]
    refused(tmp_path, RECORDED + longer, TransformError, "in a loop: base -> tool -> hand -> base")


def test_links_that_are_missing(tmp_path: Path) -> None:
    fixed = made.transform(BEGIN_NS, "world", "base", np.eye(4), "/tf_static")
    apart = [fixed, *SEEN, *(linked(m, parent_frame_id="shoulder") for m in MOVING)]
    words = "no chain of transforms from base to hand", "base -> world ends there", "hand -> shoulder does"
    refused(tmp_path, apart, TransformError, "tf base to hand", *words)
    renamed = SEEN + [linked(m, child_frame_id="flange") for m in MOVING]
    refused(tmp_path, renamed, TransformError, "no frame hand; there are: base, flange")
    still = [*SEEN, made.transform(BEGIN_NS, "base", "hand", np.eye(4), "/tf_static")]
    refused(tmp_path, still, TransformError, "static transforms only (base -> hand)", "does not move")


# Targets


def test_tags_of_another_family(tmp_path: Path) -> None:
    other = {tag: f"{{type: tag, family: tag25h9, id: {i}, size_m: {made.SIZE_M}}}" for i, tag in enumerate(made.TAGS)}
    words = "looked at 19 images or messages of cam_0", "tags that belong to no target were seen: tag36h11 0 (38 times)"
    refused(tmp_path, RECORDED, LogError, *words, "Are the families, ids and topics in the rig file right?", **other)
    messages = MOVING + images(picture(cv2.aruco.DICT_APRILTAG_25h9, 3))
    words = "looked at 6 images or messages of cam_0", "tags of other families", "tag25h9 3 (12 times)"
    refused(tmp_path, messages, LogError, *words, **WITH_IMAGES)


def test_tags_of_other_ids(tmp_path: Path) -> None:
    messages = MOVING + images(picture(cv2.aruco.DICT_APRILTAG_36h11, 7))
    refused(
        tmp_path, messages, LogError, "tags that belong to no target were seen: tag36h11 7 (12 times)", **WITH_IMAGES
    )


def test_nothing_is_seen(tmp_path: Path) -> None:
    empty = [replace(m, content=m.content | {"detections": []}) for m in SEEN]
    words = "looked at 19 images or messages of cam_0, 19 images or messages of cam_1", "no other tags"
    refused(tmp_path, MOVING + empty, LogError, *words)
    words = "looked at 6 images or messages of cam_0", "tags of other families, in a few of the images: none"
    refused(tmp_path, MOVING + images(picture()), LogError, *words, "gtsam-rwhec init LOG", **WITH_IMAGES)


def test_a_size_that_is_wrong_is_said_although_it_counts_as_known(tmp_path: Path) -> None:
    sizes = {s.target: s for s in calibrate(tmp_path, made.recording(5.0, true_size={"tag_1": 0.95})).log.sizes}
    assert [name for name, size in sizes.items() if size.is_doubted] == ["tag_1"]
    assert not sizes["tag_1"].is_free
    assert sizes["tag_1"].scale > 1.02


def test_a_drivers_size_that_is_not_the_rig_files(tmp_path: Path) -> None:
    # Without intrinsics the driver's poses stand, and with them its size.
    other = "{type: tag, family: tag36h11, id: 1, size_m: 0.24}"
    words = "topic /cam_0/tags", f"stamp {BEGIN_NS + 200_000_000} ns", "tag_1", "0.12 m", "0.24 m", "intrinsics"
    refused(tmp_path, RECORDED, LogError, *words, tag_1=other)


# Images


@pytest.mark.parametrize(
    ("data", "words"),
    [
        (b"no picture at all", "17 bytes that begin with 6e6f20706963"),
        (picture()[:60], "60 bytes of a PNG file that is cut short"),
    ],
)
def test_images_that_do_not_decode(tmp_path: Path, data: bytes, words: str) -> None:
    messages = MOVING + images(data)
    where = "topic /cam_0/image: none of the 6 images of cam_0 can be used", f"image at {BEGIN_NS} ns"
    refused(tmp_path, messages, LogError, *where, words, **WITH_IMAGES)


def test_images_that_are_empty(tmp_path: Path) -> None:
    with pytest.warns(LogWarning, match="/cam_0/image"):
        refused(tmp_path, MOVING + images(b""), LogError, "topic /cam_0/image: none of the 6 images", **WITH_IMAGES)


def test_some_images_that_do_not_decode_are_counted_and_named(tmp_path: Path) -> None:
    good, bad = images(picture(cv2.aruco.DICT_APRILTAG_36h11)), images(picture()[:60])
    log = made.write(tmp_path / "raw.mcap", MOVING + good[:-2] + bad[-2:])
    report = detect_log(log, made.rig(**WITH_IMAGES), tmp_path / "detected.mcap", workers=1)
    assert {sensor: len(faults) for sensor, faults in report.undecoded.items()} == {"cam_0": 1, "cam_1": 1}
    assert f"/cam_0/image, image at {BEGIN_NS + 2_000_000_000} ns: 60 bytes of a PNG" in report.undecoded["cam_0"][0]
    assert {track.used for track in report.tracks if track.target == "tag_0"} == {5}


# Names

ELSEWHERE = "../../x"


@pytest.mark.parametrize(
    ("pieces", "words"),
    [
        ({"tag_0": f"{TAG}\n  {ELSEWHERE}: {TAG}"}, "line 13: targets.../../x: '../../x' cannot be a frame's name"),
        ({"cam_1": f"detections: /a\n  {ELSEWHERE}: {{detections: /b}}"}, "line 11: sensors.../../x: '../../x' cannot"),
        ({"cam_1": f"detections: /a\n    frame: {ELSEWHERE}"}, "line 11: sensors.cam_1.frame: '../../x' cannot"),
        ({"poses": f"{{tf: [{ELSEWHERE}, hand]}}"}, "line 4: carriers.poses.tf[0]: '../../x' cannot"),
    ],
)
def test_a_rig_files_names_are_no_paths(pieces: dict[str, str], words: str) -> None:
    with pytest.raises(RigError) as caught:
        made.rig(**pieces)
    assert words in str(caught.value)


def test_the_names_in_an_embedded_rig_file_are_no_paths(tmp_path: Path) -> None:
    with LogWriter(tmp_path / "detected.mcap") as out:
        out.metadata(RIG_METADATA, {"yaml": made.rig_text().replace("tag_0:", f"{ELSEWHERE}:")})
        out.metadata(DETECTION_METADATA, {"json": "{}"})
    with pytest.raises(RigError, match=r"detected\.mcap, metadata gtsam_rwhec\.rig, line 12.*'\.\./\.\./x' cannot"):
        calibrate_log(tmp_path / "detected.mcap", None, tmp_path / "a" / "b" / "out")
    assert {path.name for path in tmp_path.rglob("*")} <= {"detected.mcap", "a", "b", "out"}


def test_a_logs_names_are_no_paths(tmp_path: Path) -> None:
    messages = [replace(m, topic=f"/{ELSEWHERE}/tags") if m.topic == "/cam_0/tags" else m for m in RECORDED]
    stranger = made.tag(7, np.eye(4), family=ELSEWHERE) | {"id": ELSEWHERE}
    messages.append(made.detections(f"/{ELSEWHERE}/tags", BEGIN_NS + 4 * 10**9, ELSEWHERE, [stranger]))
    messages.append(made.transform(BEGIN_NS, ELSEWHERE, "base", np.eye(4), "/tf_static"))
    messages.append(replace(made.camera_info("cam_0"), topic=ELSEWHERE))
    log = made.write(tmp_path / "raw.mcap", messages)
    out = tmp_path / "a" / "b" / "out"
    calibrated = calibrate_log(log, made.rig(cam_0=f"detections: /{ELSEWHERE}/tags"), out)
    assert calibrated.log.detection.strangers == {f"{ELSEWHERE} {ELSEWHERE}": 1}
    assert [path for path in tmp_path.rglob("*") if path.is_file() and out not in path.parents] == [log]
    assert {path.name for path in out.iterdir()} == WRITTEN | {"plots"}
    assert all(path.suffix == ".png" for path in (out / "plots").iterdir())


# Writes that end early


def check_whole(folder: Path) -> None:
    """That every file under its final name is whole, and that there are no others."""
    for path in folder.rglob("*"):
        if path.is_dir():
            continue
        assert path.name in WRITTEN | {"detected.mcap"} or path.parent.name == "plots", path
        if path.suffix == ".mcap":
            with open_log(path) as log:
                assert not log.losses
                assert sum(1 for _ in log.records(["/tf"])) == len(MOVING)
                assert set(log.metadata()) & {DETECTION_METADATA}
        elif path.name == "result.json":
            assert set(rw.read_refined(path).Y) == set(made.CAMERAS)
        elif path.suffix == ".png":
            assert cv2.imread(str(path)) is not None
        else:
            assert path.read_bytes().endswith(b"\n")


@contextmanager
def largest_file(size: int) -> Iterator[None]:
    """No file can be written that is larger, as on a disk that is full meanwhile."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


@pytest.mark.skipif(resource is None, reason="no limits of files here")
def test_stages_that_cannot_write_to_the_end(tmp_path: Path) -> None:
    raw, detected, clean, out = (tmp_path / name for name in ("raw.mcap", "detected.mcap", "clean.mcap", "out"))
    made.write(raw, RECORDED)
    with largest_file(20_000), pytest.raises(LogError, match=r"detected\.mcap cannot be written: File too large"):
        detect_log(raw, made.rig(), detected)
    assert set(tmp_path.iterdir()) == {raw}
    detect_log(raw, made.rig(), detected)
    with largest_file(20_000), pytest.raises(LogError, match=r"clean\.mcap cannot be written: File too large"):
        clean_log(detected, clean)
    assert set(tmp_path.iterdir()) == {raw, detected}
    clean_log(detected, clean)
    content = clean.read_bytes()
    with largest_file(20_000), pytest.raises(LogError, match=r"clean\.mcap cannot be written: File too large"):
        clean_log(clean, clean)
    assert clean.read_bytes() == content  # onto itself: the one before stays
    with largest_file(1000), pytest.raises(FileFormatError, match=r"result\.json cannot be written: File too large"):
        solve_into(clean, None, out)
    assert list(out.iterdir()) == []
    with (
        largest_file(len(content)),
        pytest.raises(LogError, match=r"clean\.mcap cannot be written: File too large"),
    ):
        solve_into(clean, None, out)
    assert {path.name for path in out.iterdir()} == {"result.json"}
    check_whole(out)


@pytest.fixture(scope="module")
def calibrated_before(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with raw.mcap and, in out/, a calibration of it."""
    folder = tmp_path_factory.mktemp("before")
    calibrate(folder, RECORDED)
    return folder


@pytest.mark.parametrize("stop", [KeyboardInterrupt(), OSError(errno.ENOSPC, "No space left on device")])
@pytest.mark.parametrize("name", ["detected.mcap", "clean.mcap", "result.json", "tf.yaml", "residuals.png"])
def test_a_calibration_that_ends_early_leaves_whole_files(
    calibrated_before: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str, stop: BaseException
) -> None:
    """When `name` is to get its name; into a folder in which there was a calibration before."""
    shutil.copytree(calibrated_before / "out", tmp_path / "out")
    before = {path.name: path.read_bytes() for path in (tmp_path / "out").iterdir() if path.is_file()}
    give_name = os.replace

    def stopped(source: str | Path, target: str | Path) -> None:
        if Path(target).name == name:
            raise stop
        give_name(source, target)

    # What takes long is the same each time: only the first two begin with the raw log.
    log = calibrated_before / ("raw.mcap" if name in ("detected.mcap", "clean.mcap") else "out/clean.mcap")
    rig = made.rig()
    with monkeypatch.context() as patched:
        patched.setattr(os, "replace", stopped)
        kind = KeyboardInterrupt if isinstance(stop, KeyboardInterrupt) else FileFormatError
        with pytest.raises(kind) as caught:
            calibrate_log(log, rig, tmp_path / "out")
    if kind is FileFormatError:
        assert re.search(rf"{re.escape(name)} cannot be written: No space left on device", str(caught.value))
    check_whole(tmp_path / "out")
    there = {path.name for path in (tmp_path / "out").iterdir()}
    assert there - {"detected.mcap"} == WRITTEN | {"plots"}
    assert ("detected.mcap" in there) == (name == "clean.mcap")  # from which to go on
    if name in before:
        assert (tmp_path / "out" / name).read_bytes() == before[name]


def test_an_interrupted_calibration_goes_on(tmp_path: Path) -> None:
    def interrupted(stage: str) -> None:
        if stage == "writing pairs":
            raise KeyboardInterrupt

    log, out = made.write(tmp_path / "raw.mcap", RECORDED), tmp_path / "out"
    with pytest.raises(KeyboardInterrupt):
        calibrate_log(log, made.rig(), out, progress=interrupted)
    assert {path.name for path in out.iterdir()} == {"detected.mcap"}
    check_whole(out)
    calibrate_log(out / "detected.mcap", None, out)
    check_whole(out)
    assert {path.name for path in out.iterdir()} >= WRITTEN
