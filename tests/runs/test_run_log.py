"""What stages write is told from what the raw log has; a driver's words for a family are the rig file's."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import synthetic_logs as made

from gtsam_rwhec.cameras.targets import Tag
from gtsam_rwhec.logs import DetectionRecord, LogWriter, open_log
from gtsam_rwhec.runs import run_log as log_contract
from gtsam_rwhec.runs.measured_pairs import target_of

OF_DETECTION = {
    log_contract.detections_topic("rig/cam_0"),
    log_contract.annotations_topic("rig/cam_0"),
    log_contract.poses_topic("rig/cam_0"),
}
AFTER_DETECTION = {log_contract.pairs_topic("rig/cam_0"), log_contract.SOLUTION_TOPIC}
#: The last looks like a stage's, and is another program's where no stage wrote the log.
RAW = {"/tf", "/calibration/board/detections"}


def write(path: Path, topics: set[str], *metadata: str) -> Path:
    with LogWriter(path) as out:
        for topic in topics:
            out.transforms(topic, 1, [("a", "b", np.eye(4))])
        for name in metadata:
            out.metadata(name, {"json": "{}"})
    return path


def test_topics_of_stages_are_told_from_raw_ones(tmp_path: Path) -> None:
    every = {"/tf"} | OF_DETECTION | AFTER_DETECTION
    for name in (log_contract.DETECTION_METADATA, log_contract.CLEANING_METADATA):
        with open_log(write(tmp_path / f"{name}.mcap", every, name)) as log:
            assert log_contract.is_from_stage(log)
            assert log_contract.raw_topics(log) == ["/tf"]
            assert set(log_contract.topics_up_to_detection(log)) == {"/tf"} | OF_DETECTION


def test_a_raw_log_keeps_all_its_topics(tmp_path: Path) -> None:
    with open_log(write(tmp_path / "raw.mcap", RAW)) as log:
        assert not log_contract.is_from_stage(log)
        assert set(log_contract.raw_topics(log)) == RAW


@pytest.mark.parametrize("family", ["", "tag36h11", "36h11", "tagStandard36h11", "DICT_APRILTAG_36h11"])
def test_drivers_words_for_a_family(family: str) -> None:
    target = target_of(DetectionRecord(1, 1, "/tags", "cam_0", family, "0"), made.rig().target_list)
    assert target is not None
    assert target.name == "tag_0"
    assert target_of(DetectionRecord(1, 1, "/tags", "cam_0", "tag25h9", "0"), made.rig().target_list) is None


def test_a_driver_with_a_larger_dictionary_sees_the_same_marker() -> None:
    targets = [Tag("marker", "aruco_5x5_50", 3, 0.1)]
    seen = DetectionRecord(1, 1, "/tags", "cam_0", "DICT_5X5_1000", "3")
    assert target_of(seen, targets) == targets[0]
