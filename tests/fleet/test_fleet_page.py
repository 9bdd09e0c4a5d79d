"""The page of a fleet: counts and what to do first, the worst, what moved, failures, a table with links."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
from robot_nights import failed_night, robot_nights, with_free_height

from gtsam_rwhec.calibration.verdict import Ground, Verdict
from gtsam_rwhec.fleet.fleet_page import fleet_page, put_page, write_fleet_page
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
