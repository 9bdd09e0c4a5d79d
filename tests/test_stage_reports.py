"""What stages report."""

from __future__ import annotations

import pytest
from pydantic import ValidationError

from gtsam_rwhec.stage_reports import CleaningReport, DetectionReport, LogFields, TrackCount


def log_of(*outliers: TrackCount) -> LogFields:
    return LogFields(
        sensor_carrier="hand",
        target_carrier="base",
        detection=DetectionReport(sources=("a.mcap",), images={}, undecoded={}, tracks=(), strangers={}, corner_px={}),
        cleaning=CleaningReport(tracks=(), time_offsets_s={}, coarse_sigma_s={}),
        outliers=outliers,
        sizes=(),
        time_offsets=(),
    )


def test_a_frame_most_of_whose_measurements_were_left_out_is_contradicted() -> None:
    good = TrackCount(target="tag", sensor="left", used=40, removed={"outlier": 3})
    bad = TrackCount(target="tag", sensor="right", used=4, removed={"outlier": 30})
    assert log_of(good).contradicted == ()
    assert log_of(good, bad).contradicted == ("right: 30 of its 34 measurements contradict the answer",)


def test_unknown_fields_are_refused() -> None:
    with pytest.raises(ValidationError):
        TrackCount.model_validate({"target": "t", "sensor": "s", "used": 1, "lost": 2})
