"""What is said of a sensor or a target of a rig file that has too few measurements."""

from __future__ import annotations

import pytest

from gtsam_rwhec.calibration.verdict import Ground
from gtsam_rwhec.results.log_history import CleaningReport, DetectionReport, LogFields, OutlierCount, TrackCount
from gtsam_rwhec.results.result_judgement import short_of_measurements, shortage


def track(target: str, sensor: str, used: int, **removed: int) -> TrackCount:
    return TrackCount(target=target, sensor=sensor, used=used, removed=removed)


LOG = LogFields(
    sensor_carrier="hand",
    target_carrier="base",
    detection=DetectionReport(
        sources=("a.mcap",),
        images={"left": 40, "right": 40, "rear": 12},
        undecoded={},
        tracks=(track("board", "left", 30, blurred=2), track("tag", "left", 2), track("board", "right", 9)),
        strangers={},
        unseen=("plate",),
        corner_px={},
    ),
    cleaning=CleaningReport(
        tracks=(
            track("board", "left", 30, blurred=2),
            track("tag", "left", 2),
            track("board", "right", 3, **{"standstill (m moved)": 6}),
        ),
        time_offsets_s={},
        coarse_sigma_s={},
    ),
    outliers=(
        OutlierCount(target="board", sensor="left", used=30),
        OutlierCount(target="tag", sensor="left", used=2),
        OutlierCount(target="board", sensor="right", used=2, left_out=1),
    ),
    sizes=(),
    time_offsets=(),
)


def test_each_is_named_with_what_it_had_and_what_it_needs() -> None:
    needed = "at least 3 poses with two turning axes are needed"
    found = short_of_measurements(LOG, {"left": 30, "board": 31, "right": 2, "tag": 1})
    assert [(finding.ground, finding.words) for finding in found] == [
        (
            Ground.NO_ANSWER,
            f"right: 2 measurements at 2 poses (of 9 detections in 40 images; standstill: 6; outlier: 1), {needed}",
        ),
        (Ground.NO_ANSWER, f"rear: 0 measurements (its 12 images show no target), {needed}"),
        (Ground.NO_ANSWER, f"plate: 0 measurements (no sensor saw it), {needed}"),
        (Ground.FEW_MEASUREMENTS, f"tag: 2 measurements at 1 pose (of 2 detections), {needed}"),
    ]


@pytest.mark.parametrize("name", ["left", "board"])
def test_what_was_rejected_is_counted_once(name: str) -> None:
    """The cleaning's counts hold those of the detection."""
    assert "blurred: 2" in shortage(LOG, name)
