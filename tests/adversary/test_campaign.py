"""The campaign's own arithmetic, its exit status, and the comparison of two versions."""

from __future__ import annotations

import json
from pathlib import Path

import campaign
import pytest
import share_certified
from campaign import Result, Tally
from places import REPOSITORY


def result(seed: int, **changes: object) -> Result:
    values = dict(kind="excited", scale="known", traits=[], status="certified", cost=1.0, relative_gap=1e-12)
    return Result(seed=seed, **(values | changes))  # type: ignore[arg-type]


def test_the_table_counts_by_kind_and_names_the_worst(capsys: pytest.CaptureFixture[str]) -> None:
    tally = Tally()
    tally.add(result(0))
    bad = result(1, kind="planar", status="gap", cause="rounding")
    bad.violated("bound above an answer", 2.0, 1.5, "solve")
    worse = result(2, kind="planar")
    worse.violated("bound above an answer", 9.0, 1.5, "solve")
    tally.add(bad)
    tally.add(worse)
    assert tally.number_of_violations == 2
    tally.print()
    printed = capsys.readouterr().out
    assert "VIOLATIONS: 2, in 2 of 3 problems" in printed
    assert "bound above an answer (solve): 2, of these 2 by more than 1e-6 max(cost, 1)" in printed
    assert "kinds: planar 2" in printed
    assert "worst: seed 2, 9.0 said, 1.5 found" in printed
    assert "gap: rounding: 1" in printed
    assert "proven optimal: 66.6667%" in printed


def test_rows_of_figures_are_those_of_the_kinds() -> None:
    tally = Tally()
    tally.add(result(0, kind="micrometres", relative_gap=1e-10))
    tally.add(result(1, kind="micrometres, 1000 km away", traits=["far away"], status="gap"))
    tally.add(result(2, kind="planar", has_region=True, region_ratio=300.0))
    assert tally.gaps["sigma 1 um, offset up to 1 km"] == [1e-10]
    assert tally.shares["sigma 1 um, offset 1e6 m"]["gap"] == 1
    assert "free directions, over their region" in tally.gaps
    assert tally.least_region == 300.0


def test_results_are_written_one_a_line_and_the_status_tells_of_violations(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    found = result(5)
    monkeypatch.setattr(campaign, "results", lambda *_, **__: iter([found]))
    out = tmp_path / "results.json"
    assert campaign.main(["--seeds", "5:6", "--json", str(out)]) == 0
    assert json.loads(out.read_text())["seed"] == 5
    found.violated("numpy warning", note="divide by zero")
    assert campaign.main(["--seeds", "5:6"]) == 1
    assert "numpy warning (divide by zero): 1" in capsys.readouterr().out


def test_an_exception_that_is_not_the_librarys_own_is_a_violation(monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(*_: object) -> None:
        raise ZeroDivisionError("nothing is left")

    monkeypatch.setattr(campaign, "_solve_and_judge", broken)
    found = campaign.attacked(0, sane=True)
    assert found.status == "ZeroDivisionError"
    assert [v["kind"] for v in found.violations] == ["exception ZeroDivisionError"]
    assert "in broken: nothing is left" in found.violations[0]["note"]


def test_a_version_is_as_good_as_itself(capsys: pytest.CaptureFixture[str]) -> None:
    assert share_certified.main(["--tree", str(REPOSITORY), "--seeds", "0:4", "--jobs", "1"]) == 0
    printed = capsys.readouterr().out
    assert "lost: 0" in printed
    assert "won: 0" in printed


def test_a_tree_without_the_library_is_refused(tmp_path: Path) -> None:
    with pytest.raises(SystemExit, match=r"the run of .* ended with"):
        share_certified.main(["--tree", str(tmp_path), "--seeds", "0:1", "--jobs", "1"])
