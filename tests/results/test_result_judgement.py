"""One rule says whether poses are to be used."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import pytest

import gtsam_rwhec as rw
from gtsam_rwhec.calibration.verdict import Finding, Ground, Verdict
from gtsam_rwhec.results.log_history import LogFields, SizeFields
from gtsam_rwhec.results.result_file import Result, read_result
from gtsam_rwhec.results.result_judgement import judge

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
