"""The benchmarks' scripts can start, and say rightly how a figure compares with the last that was stored."""

from __future__ import annotations

import json
import subprocess
import sys
from types import ModuleType

import pytest
from places import REPOSITORY

BENCHMARKS = REPOSITORY / "tests" / "benchmarks"
#: Their imports need what is only in the extra `bench`.
OF_BENCH = {"scs_relaxation", "real_dataset", "run_all", "own_code_against_libraries"}


def test_every_script_finds_what_it_imports() -> None:
    names = {path.stem for path in BENCHMARKS.glob("*.py")}
    try:
        import scs  # noqa: F401
    except ImportError:
        names -= OF_BENCH
    assert len(names) > 15
    lines = "\n".join(f"import {name}" for name in sorted(names))
    done = subprocess.run([sys.executable, "-c", lines], cwd=BENCHMARKS, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


def test_stored_figures_have_all_that_tells_where_they_come_from() -> None:
    stored = json.loads((BENCHMARKS / "figures.json").read_text(encoding="utf-8"))
    for name, fields in stored.items():
        assert set(fields) == {"figure", "bar", "met", "version", "machine", "date"}, name


@pytest.fixture
def figures(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    import figures

    return figures


@pytest.mark.parametrize(
    ("bar", "last", "now", "words"),
    [
        ("<= 30x", "10x (3 ms)", "13x (3 ms)", "worse than last by 30 %"),
        (">= 300x", "1000x", "500x", "worse than last by 50 %"),
        ("<= 30x", "10x (3 ms)", "5x (1 ms)", "better than last by 50 %"),
        ("<= 30x", "10.1x (3 ms)", "9.9x (4 ms)", "the same within noise"),
        ("<= 5 s", "900 ms", "1.1 s", "was (900 ms"),
        ("certified", "certified, 1e-12", "certified, 3e-12", "was (certified"),
        ("<= 1e-9", "1e-13", "4e-13", "far below the bar"),
        ("", "7 of 7", "7 of 7", "the same"),
    ],
)
def test_comparison_in_words(figures: ModuleType, bar: str, last: str, now: str, words: str) -> None:
    before, after = (figures.Figure(figure, bar, True, "0.1.0", "a machine") for figure in (last, now))
    assert figures.compared(after, before).startswith(words)


def test_times_of_another_machine_are_not_compared(figures: ModuleType) -> None:
    here, there = (figures.Figure("2x", "<= 3x", True, "0.1.0", machine) for machine in ("one", "another"))
    assert figures.compared(here, there).startswith("on another machine (2x")
    assert figures.compared(here, None) == ""
