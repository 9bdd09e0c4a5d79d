"""What stages report."""

from __future__ import annotations

import pytest
from pydantic import ValidationError

from gtsam_rwhec.results.stage_reports import CleaningReport, DetectionReport, LogFields, TrackCount, contradicted


def log_of(*outliers: TrackCount) -> LogFields:
    return LogFields(
        sensor_carrier="hand",
        target_carrier="base",
        detection=DetectionReport(sources=("a.mcap",), images={}, undecoded={}, tracks=(), strangers={}, corner_px={}),
        cleaning=CleaningReport(tracks=(), time_offsets_s={}, coarse_sigma_s={}),
        outliers=outliers,
        sizes=(),
        time_offsets=(),
        contradicted=contradicted(outliers),
    )


def test_a_frame_most_of_whose_measurements_were_left_out_is_contradicted() -> None:
    good = TrackCount(target="tag", sensor="left", used=40, removed={"outlier": 3})
    bad = TrackCount(target="tag", sensor="right", used=4, removed={"outlier": 30})
    assert log_of(good).contradictions == ()
    assert log_of(good, bad).contradictions == ("right: 30 of its 34 measurements contradict the answer",)


def test_targets_are_not_to_blame_for_a_camera() -> None:
    def track(target: str, sensor: str, used: int, out: int) -> TrackCount:
        return TrackCount(target=target, sensor=sensor, used=used, removed={"outlier": out})

    of_one = [track("a", "right", 4, 60), track("b", "right", 2, 70)]
    assert log_of(track("a", "left", 40, 3), track("b", "left", 30, 1), *of_one).contradicted == ("right",)
    # Nothing but the camera saw b: where it is rests on that camera alone.
    assert log_of(track("a", "left", 40, 3), *of_one).contradicted == ("right", "b")
    assert set(log_of(track("a", "right", 1, 60)).contradicted) == {"a", "right"}
    assert log_of().contradicted == ()


def test_unknown_fields_are_refused() -> None:
    with pytest.raises(ValidationError):
        TrackCount.model_validate({"target": "t", "sensor": "s", "used": 1, "lost": 2})
