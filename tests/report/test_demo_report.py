"""The demo says which errors we put into its log, and how far its answer is from the truth."""

from __future__ import annotations

import dataclasses
import io
from pathlib import Path

import gtsam
import numpy as np
import pytest
from rich.console import Console

import gtsam_rwhec as rw
from gtsam_rwhec.datasets import demo_truth
from gtsam_rwhec.fitting.unknowns import Unknown, UnknownKind, slots_of
from gtsam_rwhec.report.demo_report import hidden_sentences, print_demo, truth_table
from gtsam_rwhec.results.log_history import LogFields, OutlierCount, SizeFields, TrackCount

GOLDEN = Path(__file__).parents[1] / "golden"


@pytest.fixture
def found() -> tuple[rw.RefinedPoses, LogFields]:
    """A calibration that is 1 mm off in x everywhere, made of a stored one."""
    stored = rw.results.read_result(GOLDEN / "result_log.json")
    truth = demo_truth()
    assert stored.refined is not None
    assert stored.log is not None
    off = gtsam.Pose3(gtsam.Rot3(), np.array([1e-3, 0.0, 0.0]))
    X, Y = ({name: pose.compose(off) for name, pose in poses.items()} for poses in (truth.X, truth.Y))
    unknowns = [Unknown(UnknownKind.FRAME, name) for name in (*X, *Y)]
    slots = slots_of([*unknowns, Unknown(UnknownKind.TIME_OFFSET, "cam_wide")])
    size = 6 * len(unknowns) + 1
    joint = dataclasses.replace(
        stored.refined.joint, slots=slots, finite=1e-8 * np.eye(size), free=np.zeros((size, 0)), unit=np.ones(size)
    )
    refined = dataclasses.replace(stored.refined, X=X, Y=Y, time_offsets_s={"cam_wide": 0.0351}, joint=joint)
    tracks = (TrackCount(target="tag_2", sensor="cam_left", used=19, removed={"twice": 6}),)
    log = stored.log.model_copy(
        update={
            "detection": stored.log.detection.model_copy(update={"tracks": tracks}),
            "outliers": (OutlierCount(target="tag_2", sensor="cam_left", used=17),),
            "sizes": (SizeFields(target="board", stated_m=0.041, scale=1.0251, sigma=1e-4, is_free=True),),
        }
    )
    return refined, log


def test_each_difficulty_is_told_with_what_was_found(found: tuple[rw.RefinedPoses, LogFields]) -> None:
    size, clock, poster = hidden_sentences(*found, demo_truth())
    assert "41.00 mm wide. This is 2.5 % too large: they are 40.00 mm wide. Found: 39.996 mm" in size
    assert "cam_wide is 35.0 ms behind" in clock
    assert "Found: 35.10 ± 0.10 ms" in clock
    assert poster.startswith("5 images of cam_left")
    assert "Found: 8 of 25 detections" in poster


def test_every_frame_has_its_distance_from_the_truth(found: tuple[rw.RefinedPoses, LogFields]) -> None:
    table = truth_table(found[0], demo_truth())
    assert {row[0] for row in table.rows} == {"cam_left", "cam_wide", "tag_0", "tag_1", "tag_2", "tag_3", "board"}
    assert {row[1:] for row in table.rows} == {("1.00", "0.000", "outside")}


def test_it_ends_with_what_to_do_next(found: tuple[rw.RefinedPoses, LogFields]) -> None:
    out = io.StringIO()
    print_demo(*found, demo_truth(), Path("here"), Console(file=out, width=160))
    headings = (
        "Errors that we put into",
        "How far the answer is from the truth",
        "What to do next",
        "gtsam-rwhec init",
    )
    places = [out.getvalue().index(words) for words in headings]
    assert places == sorted(places)
    assert "here/report.html" in out.getvalue()
