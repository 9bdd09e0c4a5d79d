"""The short report: one screen at most, with what a person must do; and the demo's, which tells its log's errors."""

from __future__ import annotations

import dataclasses
import io
import math
from dataclasses import replace
from pathlib import Path

import gtsam
import numpy as np
import pytest
from rich.console import Console
from rich.text import Text

import gtsam_rwhec as rw
from gtsam_rwhec.calibration.point_uncertainty import PointUncertainty
from gtsam_rwhec.calibration.verdict import Finding, Ground
from gtsam_rwhec.datasets import demo_truth
from gtsam_rwhec.fitting.unknowns import Unknown, UnknownKind, slots_of
from gtsam_rwhec.report.calibration_report import with_largest
from gtsam_rwhec.report.demo_report import hidden_sentences, print_demo, truth_table
from gtsam_rwhec.report.report_blocks import Table
from gtsam_rwhec.report.short_report import LINES, PoseTables, ShortReport, lines_beside
from gtsam_rwhec.report.verdict_section import DEVIATION_HEADINGS, POSE_HEADINGS
from gtsam_rwhec.results.log_history import LogFields, OutlierCount, SizeFields, TrackCount

WIDTHS = (80, 120)


def console(stream: io.StringIO, width: int, *, terminal: bool = True) -> Console:
    return Console(file=stream, width=width, force_terminal=terminal, color_system=None, highlight=False)


def printed(calibration: rw.Calibration, width: int = 80, **options: object) -> str:
    stream = io.StringIO()
    rw.report.print_calibration(calibration, console(stream, width), **options)  # type: ignore[arg-type]
    return stream.getvalue()


def frames(kind: str, number: int) -> Table:
    """Many frames, whose rows differ."""
    rows = {f"{kind}_{i}": tuple(f"{i + j / 8:.4f}" for j in range(12)) for i in range(number)}
    return Table.of(f"{kind}s", kind, (*POSE_HEADINGS, *DEVIATION_HEADINGS), rows)


def large(sensors: int, targets: int, facts: int, advice: int, sentences: int) -> ShortReport:
    """A report with much to say."""
    found = [Finding(Ground.CORRELATED, f"fact number {i} of a long list of facts") for i in range(facts)]
    tables = (frames("sensor", sensors), frames("target", targets))
    points = tuple(
        PointUncertainty(
            np.ones(3), f"sensor_{i}", "hand", 0.95, np.ones(3), np.eye(3), np.eye(3), np.ones(3), 1.0 + i, 0.5
        )
        for i in range(sensors)
    )
    return ShortReport(
        judgement=rw.Judgement.of(found, "nothing speaks against them"),
        advice=tuple(
            (f"Do the thing of number {i}, and what it asks for in many words.", "") for i in range(advice)),
        points=points,
        poses=(PoseTables(tables, "±: of all axes."), PoseTables(tuple(map(with_largest, tables)), "±: the largest.")),
        sentences=tuple((f"A sentence of number {i}.", "") for i in range(sentences)),
    )  # fmt: skip


@pytest.mark.parametrize("width", WIDTHS)
@pytest.mark.parametrize(
    "size", [(2, 5, 1, 0, 3), (8, 16, 9, 1, 1), (1, 100, 0, 0, 0), (20, 100, 60, 30, 20), (100, 100, 12, 3, 9)]
)
def test_it_is_never_longer_than_a_screen(size: tuple[int, int, int, int, int], width: int) -> None:
    stream = io.StringIO()
    large(*size).print(console(stream, width), whole="--verbose", page=Path("out/report.html"))
    lines = stream.getvalue().splitlines()
    assert len(lines) <= LINES
    assert max(map(len, lines)) <= width
    assert lines[-1] == "Everything else: out/report.html, or --verbose."
    text = " ".join(stream.getvalue().split())
    if sum(size[:2]) > LINES:  # no line is wasted
        assert len(lines) == LINES
        assert " more targets not shown here." in text
    for count, words in ((size[3], "Do the thing of number "), (size[4], "A sentence of number ")):
        said = text.count(words)
        left = count - said
        assert said == count or f"- and {left} more" in text
        assert said > 0 or count == 0


@pytest.mark.parametrize("width", WIDTHS)
def test_in_a_file_sentences_count_as_on_a_narrow_terminal(width: int) -> None:
    stream = io.StringIO()
    out = console(stream, width, terminal=False)
    large(8, 30, 9, 1, 1).print(out, whole="--verbose")
    shown = sum(max(1, len(Text(line).wrap(out, 80))) for line in stream.getvalue().splitlines())
    assert shown <= LINES


def test_the_verdict_is_first_and_whole_and_every_frame_is_there(calibration: rw.Calibration) -> None:
    for width in WIDTHS:
        text = printed(calibration, width)
        assert len(text.splitlines()) <= LINES
        assert " ".join(text.split()).startswith(str(calibration.judgement))
        places = [text.index(words) for words in ("How far off a point is", "Sensors in", "Targets in", "Everything")]
        assert places == sorted(places)
        for name in (*calibration.X, *calibration.Y):
            assert f"\n{name} " in text
        assert text.endswith("Everything else: print_calibration(calibration, verbose=True).\n")
    deviations = calibration.standard_deviations("sensor0")[1]
    (row, *_) = [line for line in printed(calibration, 160).splitlines() if line.startswith("sensor0 ")]
    np.testing.assert_allclose([float(cell) for cell in row.split()[7:10]], deviations, atol=0.0051)


def test_of_many_sensors_the_worst_is_named() -> None:
    stream = io.StringIO()
    large(9, 3, 0, 0, 0).print(console(stream, 80), whole="--verbose")
    said = stream.getvalue()
    assert "  - sensor_8: within 9 mm, 1.73 m away" in said
    assert "This is the worst of 9 sensors. The other 8: 1 mm to 8 mm." in said


def test_one_that_is_not_determined_is_the_worst() -> None:
    report = large(9, 3, 0, 0, 0)
    points = (*report.points[:-1], replace(report.points[-1], frame="cam", radius_mm=math.inf))
    stream = io.StringIO()
    replace(report, points=points).print(console(stream, 80), whole="--verbose")
    assert "  - cam: not determined, 1.73 m away" in stream.getvalue()


def test_frames_that_are_not_to_be_used_are_among_the_rows() -> None:
    stream = io.StringIO()
    replace(large(2, 100, 0, 0, 0), marked=frozenset({"target_93"})).print(console(stream, 80), whole="--verbose")
    assert "\ntarget_93 " in stream.getvalue()
    assert "\ntarget_92 " not in stream.getvalue()


def test_where_columns_do_not_fit_the_largest_deviation_stands_for_all() -> None:
    cells = (*"123456", "7.1", "9.0", "8.3", "0.1", "free", "0.3")
    table = Table.of("", "", (*POSE_HEADINGS, *DEVIATION_HEADINGS), {"a": cells})
    assert with_largest(table).rows == (("a", *"123456", "9.0", "free"),)


def test_warnings_and_frames_without_covariances_are_said(calibration: rw.Calibration) -> None:
    text = printed(replace(calibration, notes=("something is odd",), refined=None))
    assert "something is odd" in text
    assert "rms mm" in text
    assert "How far off" not in text


def test_what_a_command_says_besides_takes_lines() -> None:
    out = console(io.StringIO(), 80)
    assert lines_beside((), out) == LINES
    assert lines_beside(("short", "word " * 30), out) == LINES - 3
    assert lines_beside(("word " * 5_000,), out) == LINES // 2


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
