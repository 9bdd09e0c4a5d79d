"""What became of the measurements of a log."""

from __future__ import annotations

import pytest
from pydantic import ValidationError

from gtsam_rwhec.calibration.outliers import LeftOut
from gtsam_rwhec.results.log_history import CleaningReport, LogFields, OutlierCount, TrackCount
from gtsam_rwhec.results.removed_measurements import RemovalReason


def contradicted(*outliers: OutlierCount, cleaned: tuple[TrackCount, ...] = ()) -> tuple[LeftOut, ...]:
    cleaning = CleaningReport.model_construct(tracks=cleaned)
    return LogFields.model_construct(outliers=outliers, cleaning=cleaning).contradicted


def names(*outliers: OutlierCount) -> list[str]:
    return [counts.frame for counts in contradicted(*outliers)]


def test_a_frame_most_of_whose_measurements_were_left_out_is_contradicted() -> None:
    good = OutlierCount(target="tag", sensor="left", used=40, left_out=3)
    bad = OutlierCount(target="tag", sensor="right", used=4, left_out=30)
    assert contradicted(good) == ()
    assert contradicted(good, bad) == (LeftOut(frame="right", left_out=30, measurements=34),)


def test_targets_are_not_to_blame_for_a_camera() -> None:
    def pair(target: str, sensor: str, used: int, left_out: int) -> OutlierCount:
        return OutlierCount(target=target, sensor=sensor, used=used, left_out=left_out)

    of_one = [pair("a", "right", 4, 60), pair("b", "right", 2, 70)]
    assert names(pair("a", "left", 40, 3), pair("b", "left", 30, 1), *of_one) == ["right"]
    # Nothing but the camera saw b: where it is rests on that camera alone.
    assert names(pair("a", "left", 40, 3), *of_one) == ["right", "b"]
    assert set(names(pair("a", "right", 1, 60))) == {"a", "right"}
    assert names() == []


def test_nearly_half_of_many_measurements_is_enough() -> None:
    def board(used: int, left_out: int) -> OutlierCount:
        return OutlierCount(target="board", sensor="camera", used=used, left_out=left_out)

    assert names(board(16, 14)) == ["board", "camera"]
    assert names(board(20, 10)) == []
    assert names(board(4, 4)) == ["board", "camera"]  # half against half: nobody knows which are right
    assert names(board(5, 3)) == []
    half_of_the_board = OutlierCount(target="board", sensor="late", used=25, left_out=50)
    assert names(board(25, 0), half_of_the_board) == ["late"]


def test_what_cleaning_removes_for_the_motion_counts_with_the_outliers() -> None:
    """37 of 76 images of another camera: 18 by cleaning, 19 as outliers, and none of these alone was many."""
    kept = OutlierCount(target="board", sensor="camera", used=39, left_out=19)
    off = {RemovalReason.ROTATION_OFF.value: 18, RemovalReason.STANDSTILL.value: 100}
    cleaned = TrackCount(target="board", sensor="camera", used=58, removed=off)
    assert contradicted(kept) == ()
    found = contradicted(kept, cleaned=(cleaned,))
    assert LeftOut(frame="camera", left_out=37, measurements=76) in found


def test_unknown_fields_are_refused() -> None:
    with pytest.raises(ValidationError):
        TrackCount.model_validate({"target": "t", "sensor": "s", "used": 1, "lost": 2})
