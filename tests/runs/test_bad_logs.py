"""Logs and rig files from which no calibration can be made, the whole way: what is refused, where, and what to do."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import synthetic_logs as made
from bad_logs import MOVING, RECORDED, SEEN, WITH_IMAGES, images, linked, picture, refused
from synthetic_logs import BEGIN_NS

from gtsam_rwhec.errors import LogError, LogWarning, TransformError
from gtsam_rwhec.runs.detection_stage import detect_log
from gtsam_rwhec.runs.whole_runs import calibrate_log

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
    words = (
        "looked at 6 images or messages of cam_0",
        "tag_0: 4 of 4 images show tags of tag25h9 and none of tag36h11: write family: tag25h9 (",
    )
    refused(tmp_path, messages, LogError, *words, **WITH_IMAGES)


def test_tags_of_other_ids(tmp_path: Path) -> None:
    messages = MOVING + images(picture(cv2.aruco.DICT_APRILTAG_36h11, 7))
    refused(
        tmp_path,
        messages,
        LogError,
        "tags that belong to no target were seen: tag36h11 7 (12 times)",
        "tag_0: 4 of 4 images show the tag 7 of tag36h11, and none shows 0: write id: 7 (",
        **WITH_IMAGES,
    )


def test_nothing_is_seen(tmp_path: Path) -> None:
    empty = [replace(m, content=m.content | {"detections": []}) for m in SEEN]
    words = "looked at 19 images or messages of cam_0, 19 images or messages of cam_1", "no other tags"
    refused(tmp_path, MOVING + empty, LogError, *words)
    words = "looked at 6 images or messages of cam_0", "images were searched for them with other families"
    refused(tmp_path, MOVING + images(picture()), LogError, *words, "gtsam-rwhec init LOG", **WITH_IMAGES)


def test_a_size_that_is_wrong_is_said_although_it_counts_as_known(tmp_path: Path) -> None:
    messages = made.recording(5.0, true_size={"tag_1": 0.95})
    sizes = {s.target: s for s in made.solved(tmp_path, messages, made.rig_text()).log.sizes}
    assert [name for name, size in sizes.items() if size.is_doubted] == ["tag_1"]
    assert not sizes["tag_1"].is_free
    assert sizes["tag_1"].scale > 1.02


def test_a_drivers_size_that_is_not_the_rig_files(tmp_path: Path) -> None:
    # Without intrinsics the driver's poses stand, and with them its size.
    other = "{type: tag, family: tag36h11, id: 1, size_m: 0.24}"
    words = "topic /cam_0/tags", f"stamp {BEGIN_NS + 200_000_000} ns", "tag_1", "0.12 m", "0.24 m", "intrinsics"
    refused(tmp_path, RECORDED, LogError, *words, tag_1=other)
