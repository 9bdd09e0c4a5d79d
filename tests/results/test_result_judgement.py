"""One rule says whether poses are to be used; what became of a log's measurements, and frames that have too few."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import pytest
from pydantic import ValidationError

import gtsam_rwhec as rw
from gtsam_rwhec.calibration.outliers import LeftOut
from gtsam_rwhec.calibration.verdict import Finding, Ground, Verdict
from gtsam_rwhec.results.log_history import (
    CleaningReport,
    DetectionReport,
    LogFields,
    OutlierCount,
    RemovalReason,
    SizeFields,
    TrackCount,
)
from gtsam_rwhec.results.result_file import Result, read_result
from gtsam_rwhec.results.result_judgement import judge, short_of_measurements, shortage

GOLDEN = Path(__file__).parents[1] / "golden"


@pytest.fixture(scope="module")
def result() -> Result:
    """A good calibration of a log."""
    return read_result(GOLDEN / "result_log.json")


def with_status(solution: rw.Solution, status: rw.Status) -> rw.Solution:
    return dataclasses.replace(solution, certificate=dataclasses.replace(solution.certificate, status=status))


def test_a_good_calibration_is_to_be_used(result: Result) -> None:
    judgement = judge(result.solution, result.refined, result.log)
    assert (judgement.verdict, judgement.grounds) == (Verdict.USE, ())
    assert str(judgement).startswith("Use these poses: ")
    assert judge(result.solution).verdict is Verdict.USE


@pytest.mark.parametrize(
    ("status", "verdict", "ground"),
    [
        (rw.Status.GAP, Verdict.DO_NOT_USE, Ground.NOT_CERTIFIED),
        (rw.Status.FAILED, Verdict.DO_NOT_USE, Ground.NO_BOUND),
        (rw.Status.CERTIFIED_NOT_UNIQUE, Verdict.DO_NOT_USE, Ground.NOT_UNIQUE),
    ],
)
def test_the_certificate_is_asked(result: Result, status: rw.Status, verdict: Verdict, ground: Ground) -> None:
    judgement = judge(with_status(result.solution, status), result.refined, result.log)
    assert (judgement.verdict, judgement.grounds) == (verdict, (ground,))


def test_what_only_refining_leaves_free_counts_too(result: Result) -> None:
    first = read_result(GOLDEN / "result_free.json").solution
    assert judge(first).grounds == (Ground.NOT_UNIQUE,)
    assert result.refined is not None
    free: list[Any] = list(first.identifiability.free_directions)
    refined = dataclasses.replace(result.refined, free_directions=free)
    assert judge(result.solution, refined).grounds == (Ground.NOT_UNIQUE,)


def changed(log: LogFields | None, **fields: Any) -> LogFields:
    assert log is not None
    return log.model_copy(update=fields)


def with_cam_side_contradicted(log: LogFields | None, **fields: Any) -> LogFields:
    """All but three of its measurements are left out."""
    assert log is not None
    outliers = tuple(
        count.model_copy(update={"used": 3, "left_out": 20}) if count.sensor == "cam_side" else count
        for count in log.outliers
    )
    return changed(log, outliers=outliers, **fields)


def test_contradicted_frames_are_not_to_be_used(result: Result) -> None:
    log = with_cam_side_contradicted(result.log)
    judgement = judge(result.solution, result.refined, log)
    assert (judgement.verdict, judgement.grounds) == (Verdict.DO_NOT_USE, (Ground.CONTRADICTED,))
    assert "20 of 23 measurements of cam_side contradict the answer" in judgement.reason


@pytest.mark.parametrize(("is_free", "verdict"), [(False, Verdict.DO_NOT_USE), (True, Verdict.USE)])
def test_a_doubted_size_is_not_to_be_used_unless_it_was_estimated(
    result: Result, is_free: bool, verdict: Verdict
) -> None:
    size = SizeFields(target="tag_7", stated_m=0.1, scale=1.02, sigma=0.001, is_free=is_free)
    assert judge(result.solution, result.refined, changed(result.log, sizes=(size,))).verdict is verdict


def test_the_worst_ground_decides_and_all_are_said(result: Result) -> None:
    size = SizeFields(target="tag_7", stated_m=0.1, scale=1.02, sigma=0.001, is_free=False)
    log = with_cam_side_contradicted(result.log, sizes=(size,))
    judgement = judge(with_status(result.solution, rw.Status.GAP), result.refined, log)
    assert judgement.verdict is Verdict.DO_NOT_USE
    assert judgement.grounds == (Ground.NOT_CERTIFIED, Ground.CONTRADICTED, Ground.SIZE_DOUBTED)
    assert "tag_7" in judgement.reason


def test_outliers_of_a_stream_are_said_once(result: Result) -> None:
    """``calibrate`` speaks of a stream from 15 % on, and the file's counts speak from 30 % on."""
    assert result.log is not None
    counts = [count.model_copy(update={"used": 6, "left_out": 4}) for count in result.log.outliers]
    log = changed(result.log, outliers=tuple(counts))
    said = [Finding(Ground.MANY_OUTLIERS, "4 of 10 contradict the answer")]
    for findings in ([], said):
        judgement = judge(result.solution, result.refined, log, findings)
        assert judgement.grounds == (Ground.MANY_OUTLIERS,)
        assert judgement.reason.count("contradict the answer") == 1


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
