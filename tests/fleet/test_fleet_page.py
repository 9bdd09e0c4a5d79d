"""What people read of a fleet: the page, and what ``fleet run`` prints."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from robot_nights import failed_night, robot_nights, with_free_height
from test_fleet_rows import row
from typer.testing import CliRunner

import gtsam_rwhec as rw
from gtsam_rwhec import fleet
from gtsam_rwhec.calibration.verdict import Ground, Verdict
from gtsam_rwhec.cli.app import app
from gtsam_rwhec.fleet.fleet_page import fleet_page, put_page, write_fleet_page
from gtsam_rwhec.fleet.fleet_report import failures_of, summary, worst_first
from gtsam_rwhec.fleet.fleet_rows import RobotRow
from gtsam_rwhec.fleet.watching import Watched, watch
from gtsam_rwhec.report.report_blocks import Chart, Link, Number, Table


@pytest.fixture(scope="module")
def rows() -> list[RobotRow]:
    use, care, free = (robot_nights(f"arm_{i}", 1)[0] for i in range(3))
    return [
        use,
        replace(
            care,
            verdict=Verdict.CARE,
            grounds=(Ground.LITTLE_ROTATION,),
            reason="Little rotation.",
            result="a b/?.json",
        ),
        replace(with_free_height(free), reason="The height of <cam> is free."),
        failed_night("arm_3", 0),
    ]


@pytest.fixture(scope="module")
def watched() -> Watched:
    return watch([*robot_nights("arm_0", 16), *robot_nights("arm_1", 16, moved_at=14)])


def test_the_counts_come_first_and_then_what_to_do(rows: list[RobotRow], watched: Watched) -> None:
    page = fleet_page(rows, watched)
    counts, steps = page.sections[0].blocks
    assert (counts.tone, page.tone) == ("bad", "bad")
    assert counts.words.startswith("4 calibrations: 1 may be used, 1 to be used with care, 1 not to be used, 1 failed.")
    assert len(steps.items) == 5
    names = [section.name for section in page.sections]
    assert names == ["verdict", "drift", "worst", "failures", "robots"]
    assert fleet_page(rows[:1]).tone == "good"
    assert fleet_page(rows[:1], watched).tone == "care"
    assert [row[1] for row in page.sections[2].blocks[0].rows] == ["do not use", "with care"]


def test_the_table_has_every_robot_with_a_link_and_its_numbers(rows: list[RobotRow]) -> None:
    *_, table = fleet_page(rows, has_results=True).sections[-1].blocks
    assert isinstance(table, Table)
    assert table.sorts
    assert [row[0].href if isinstance(row[0], Link) else row[0] for row in table.rows] == [
        "./robots/arm_0%400/result.json", "./a%20b/%3F.json", "./robots/arm_2%400/result.json", "arm_3@0",
    ]  # fmt: skip
    numbers = [cell for cell in table.rows[0] if isinstance(cell, Number)]
    assert [number.text for number in numbers[:2]] == ["0.2", "0.0573"]
    assert table.rows[2][3].text == "free"
    assert all(number.of.startswith("fleet.json#/rows/0/") for number in numbers)


def test_a_run_of_many_days_says_what_moved_in_one_file(rows: list[RobotRow], tmp_path: Path) -> None:
    put_page([*rows, *robot_nights("arm_5", 16), *robot_nights("arm_1", 16, moved_at=14)], str(tmp_path))
    html = (tmp_path / "summary.html").read_text(encoding="utf-8")
    assert "Moved by more than chance: 1 of " in html
    assert 'href="./a%20b/%3F.json"' in html
    assert "<cam>" not in html
    assert "The height of &lt;cam&gt; is free." in html


def test_the_page_of_the_watch_has_a_chart_for_each_robot_that_moved(watched: Watched, tmp_path: Path) -> None:
    nights = robot_nights("arm_1", 16, moved_at=14)
    page = fleet_page(nights, watched)
    charts = [block for block in page.sections[1].blocks if isinstance(block, Chart)]
    assert [chart.title for chart in charts] == ["arm_1"]
    assert charts[0].says == str(watched.alarms[0])
    later = fleet_page(nights, watched, since_ns=watched.alarms[0].when_ns + 1)
    assert (page.tone, later.tone) == ("care", "good")
    write_fleet_page(nights, watched, tmp_path / "drift.html")
    assert (tmp_path / "drift.html").is_file()


def printed_rows() -> list[fleet.RobotRow]:
    fine = replace(row(), unit="b", robot="b", site=None, verdict=rw.Verdict.USE, failed_logs=(), covariance=np.eye(6))
    bad = replace(fine, unit="c", robot="c", verdict=rw.Verdict.DO_NOT_USE)
    return [
        fine,
        replace(fine, unit="d", covariance=2.0 * np.eye(6)),
        row(),
        bad,
        fleet.RobotRow("e", "e", failure="no"),
    ]


def test_verdicts_first_then_the_worst_then_failures() -> None:
    assert summary(printed_rows()) == (
        "5 calibrations: 2 may be used, 1 to be used with care, 1 not to be used, 1 failed. 1 log could not be used."
    )
    assert [one.unit for one in worst_first(printed_rows())] == ["c", "a@2026-11-22", "d", "b"]
    assert failures_of(printed_rows()) == ["e: no", "a@2026-11-22, a, s3://logs/ä.mcap: it is empty"]
    assert summary([]) == "0 calibrations: none."


def test_the_command_and_its_exit_status(tmp_path: Path) -> None:
    (tmp_path / "fleet.yaml").write_text("rig: rig.yaml\nrobots: {a: none.mcap}\n")
    run = CliRunner().invoke
    lacking = run(app, ["fleet", "run", str(tmp_path / "fleet.yaml"), "-o", str(tmp_path / "out")])
    assert lacking.exit_code == 2
    assert "rig.yaml" in lacking.stderr
    (tmp_path / "rig.yaml").write_text(
        "carriers: {sensors: hand, targets: base, poses: {tf: [base, hand]}}\nsensors: {cam: {detections: /tags}}\n"
        "targets: {tag: {type: tag, family: tag36h11, id: 0, size_m: 0.1}}\n"
    )
    failed = run(app, ["fleet", "run", str(tmp_path / "fleet.yaml"), "-o", str(tmp_path / "out")])
    assert failed.exit_code == 1
    assert failed.stdout.startswith("1 calibration: 1 failed. 1 log could not be used.")
    assert "What failed\n  - a: no calibration from " in failed.stdout
    assert "Nothing new was computed; 0 files were there already." in failed.stdout
    assert (tmp_path / "out" / "fleet.json").is_file()
    for arguments, words in (
        ([f"{tmp_path}/*.mcap"], "needs --rig"),
        ([str(tmp_path / "fleet.yaml"), "--rig", "x"], "goes with a pattern"),
        ([f"{tmp_path}/*.mcap", "--rig", "x"], "no log matches"),
        ([str(tmp_path / "fleet.yaml"), "--memory-per-worker", "lots"], "is no size of memory"),
    ):
        refused = run(app, ["fleet", "run", *arguments, "-o", str(tmp_path / "out")])
        assert refused.exit_code == 2
        assert words in " ".join(refused.stderr.replace("│", " ").split())
