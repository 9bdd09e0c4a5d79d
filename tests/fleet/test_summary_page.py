"""The summary page over all robots: counts first, what to do, the worst, what drifted, failures, a table with links."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
from robot_nights import failed_night, robot_nights, with_free_height

from gtsam_rwhec.calibration.verdict import Ground, Verdict
from gtsam_rwhec.fleet.rows import RobotRow
from gtsam_rwhec.fleet.summary_page import counts_in_words, put_summary, summary_page, write_summary
from gtsam_rwhec.fleet.watch_page import watch_page
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
    page = summary_page(rows, watched)
    first = page.sections[0].blocks
    words = "Of 4 calibrations of 4 robots, 1 may be used, 1 may be used with care, 1 must not be used, 1 failed."
    assert (first[0].words, first[0].tone, page.tone) == (words, "bad", "bad")
    assert len(first[1].items) == 5
    names = [section.name for section in page.sections]
    assert names == ["verdict", "worst", "drift", "failures", "figures", "robots"]
    assert counts_in_words([]) == "There is no robot in this run."
    assert summary_page(rows[:1]).tone == "good"
    assert summary_page(rows[:1], watched).tone == "care"


def test_the_worst_are_those_that_must_not_be_used(rows: list[RobotRow]) -> None:
    [table] = summary_page(rows).sections[1].blocks
    assert [row[1] for row in table.rows] == ["do not use", "with care"]


def test_the_table_has_every_robot_with_a_link_and_its_numbers(rows: list[RobotRow]) -> None:
    [table] = summary_page(rows).sections[-1].blocks
    assert isinstance(table, Table)
    assert table.sorts
    assert [row[0].href if isinstance(row[0], Link) else row[0] for row in table.rows] == [
        "./robots/arm_0%400/result.json", "./a%20b/%3F.json", "./robots/arm_2%400/result.json", "arm_3@0",
    ]  # fmt: skip
    numbers = [cell for cell in table.rows[0] if isinstance(cell, Number)]
    assert [number.text for number in numbers[:2]] == ["0.2", "0.0573"]
    assert table.rows[2][3].text == "free"
    assert all(number.of.startswith("fleet.json#/rows/0/") for number in numbers)


def test_it_is_one_file_without_names_that_are_html(rows: list[RobotRow], watched: Watched, tmp_path: Path) -> None:
    write_summary(rows, tmp_path / "summary.html", watched)
    html = (tmp_path / "summary.html").read_text(encoding="utf-8")
    assert "<cam>" not in html
    assert "The height of &lt;cam&gt; is free." in html
    assert 'href="./a%20b/%3F.json"' in html


def test_a_run_of_many_days_says_what_moved(tmp_path: Path) -> None:
    put_summary([*robot_nights("arm_0", 16), *robot_nights("arm_1", 16, moved_at=14)], str(tmp_path))
    html = (tmp_path / "summary.html").read_text(encoding="utf-8")
    assert "Of 32 calibrations of 2 robots, 32 may be used." in html
    assert "Moved by more than chance: 1 of 2 robots, 32 nights: arm_1." in html


def test_the_page_of_the_watch_has_a_chart_for_each_robot_that_moved(watched: Watched) -> None:
    page = watch_page(watched)
    charts = [block for section in page.sections for block in section.blocks if isinstance(block, Chart)]
    assert [chart.title for chart in charts] == ["arm_1"]
    assert charts[0].says == str(watched.alarms[0])
    quiet = watch_page(watch(robot_nights("arm_0", 16)))
    assert (page.tone, quiet.tone) == ("bad", "good")
    assert [section.name for section in quiet.sections] == ["verdict", "remarks"]
