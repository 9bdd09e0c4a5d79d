"""Parts of long campaigns: which seeds come next, how parts add up, and what becomes of a failing case."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import numpy as np
import pytest
from places import REPOSITORY

sys.path.insert(0, str(REPOSITORY / "benchmarks"))
import campaign_sums
import campaigns
import changes
import wrong_assumptions
from campaign_sums import Campaign, Counts


@pytest.fixture
def kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Where parts go; odd numbers fail, and 4 raises."""

    def one(seed: int) -> campaign_sums.Found:
        if seed == 4:
            raise ValueError("four")
        return Counts({"tried": 1, "half": 0.5 * seed}), ["odd: wrong"] * (seed % 2)

    path = tmp_path / "campaigns.json"
    monkeypatch.setattr(campaigns, "KEPT", path)
    monkeypatch.setattr(campaigns, "product", lambda: "abc")
    monkeypatch.setitem(campaigns.CAMPAIGNS, "few_measurements", Campaign(12, "numbers", one, lambda *_: [], ""))
    return path


def add(first: int, last: int) -> None:
    parts = campaigns.kept_parts()
    campaigns.keep(campaigns.added(campaigns.run("few_measurements", range(first, last)), parts))


def test_parts_add_up_and_seeds_between_them_come_next(kept: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    name = "few_measurements"
    add(0, 3)
    add(6, 8)
    parts = campaigns.kept_parts()
    assert [part["seeds"] for part in parts] == [[0, 3], [6, 8]]
    assert campaigns.next_seeds(name, parts) == range(3, 6)
    add(3, 6)
    (joined, apart) = campaigns.kept_parts()
    assert (joined["seeds"], apart["seeds"]) == ([0, 6], [6, 8])
    assert joined["counts"] == {"half": 0.5 * (0 + 1 + 2 + 3 + 5), "tried": 5}  # 4 raised
    assert [case["seed"] for case in joined["failing"]] == [1, 3, 4, 5]
    monkeypatch.setattr(campaigns, "product", lambda: "newer")
    add(8, 12)
    parts = campaigns.kept_parts()
    assert [part["commit"] for part in parts] == ["abc", "abc", "newer"]
    assert not campaigns.next_seeds(name, parts)
    seeds, _, sums, open_cases = campaigns.sums_of(name, parts)
    assert (seeds, sums["tried"], open_cases) == (12, 11, 7)
    raised = next(row for row in campaigns.table([name], parts) if row.what.strip() == "seeds that raised")
    assert (raised.figure, raised.met) == ("1", False)
    assert json.loads(kept.read_text())["parts"] == parts


def test_a_part_ends_when_it_has_taken_its_time(kept: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(campaigns, "PART_S", -1.0)
    assert campaigns.run("few_measurements", range(2, 9))["seeds"] == [2, 3]


def test_the_campaign_that_is_soonest_at_half_comes_first(kept: Path) -> None:
    def part(name: str, seeds: int, seconds: float) -> dict[str, object]:
        return {"campaign": name, "seeds": [0, seeds], "seconds": seconds, "failing": [], "counts": {}}

    parts = [part("few_measurements", 6, 1.0), part("split_halves", 10, 30.0), part("boards", 10, 30.0)]
    names = ["few_measurements", "split_halves", "boards", "gallery"]
    order = sorted(names, key=lambda name: campaigns.order_of(name, parts))
    assert order == ["gallery", "split_halves", "boards", "few_measurements"]


def test_a_case_that_fails_no_longer_is_mended(kept: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    name = "few_measurements"
    add(0, 4)
    cured = Campaign(12, "numbers", lambda seed: (Counts(), ["odd: still"] * (seed == 3)), lambda *_: [], "")
    monkeypatch.setitem(campaigns.CAMPAIGNS, name, cured)
    campaigns.run_again(name, [])
    first, second = campaigns.kept_parts()[0]["failing"]
    assert (first["seed"], first.get("mended"), second["seed"], second.get("mended")) == (1, "abc", 3, None)
    assert campaigns.sums_of(name, campaigns.kept_parts())[3] == 1


def test_seeds_are_those_of_the_scripts(monkeypatch: pytest.MonkeyPatch) -> None:
    seen = []
    nothing = wrong_assumptions.Outcome({}, Counts(), 1)
    monkeypatch.setattr(wrong_assumptions, "run_chunk", lambda name, seeds: seen.append((name, seeds)) or nothing)
    campaign_sums.assumptions(7)
    rows = np.random.SeedSequence(0).spawn(len(wrong_assumptions.CASES))
    for (name, (seed,)), expected, row in zip(seen, wrong_assumptions.CASES, rows, strict=True):
        assert name == expected
        assert np.array_equal(seed.generate_state(4), row.spawn(8)[7].generate_state(4))


#: For each campaign sums that meet its bars, and what more misses one: of changes a thousand pairs of each kind.
OF_CHANGES = {"answered": 1000, "diff": 10, "verify": 10, "frame": 830, "together": 800}
OF_CHANGES |= {"one_expected": 700, "verified_one": 175, "verified of": 250}
SUMS = {
    "misreadings": ({"good": 1}, {}),
    "gallery": ({"bad": 15, "named": 14, "good": 15}, {"accused": 1}),
    "changes": ({f"{k} {w}": n for k in changes.KINDS for w, n in OF_CHANGES.items()}, {"white diff": 30}),
    "few_measurements": ({"free 2": 9, "free_unique 2": 1, "rich 3": 9, "rich_unique 3": 9}, {"free_unique 2": 1}),
    "adversary": ({"status certified": 9}, {}),
}


@pytest.mark.parametrize("name", SUMS)
def test_sums_are_held_to_bars(name: str) -> None:
    """A failing case misses the bar where none may fail."""
    good, more = SUMS[name]
    rows = campaign_sums.CAMPAIGNS[name].bars(Counts(good), 0)
    assert all(row.met for row in rows if row.bar), rows
    assert not all(row.met for row in campaign_sums.CAMPAIGNS[name].bars(Counts(good) + Counts(more), 1) if row.bar)


def test_an_attack_of_the_certificate_is_counted() -> None:
    counts, failing = campaign_sums.CAMPAIGNS["adversary_sane"].one(0)
    assert (counts["status certified"], failing) == (1, [])
