"""The progress display, on terminals and in logs."""

from __future__ import annotations

import io
import pickle
import re
import time

import pytest
from rich.console import Console

from gtsam_rwhec.cli import stage_display
from gtsam_rwhec.cli.stage_display import StageDisplay
from gtsam_rwhec.files.progress import Counted, Pace, duration, share


def display(*, terminal: bool) -> tuple[StageDisplay, io.StringIO]:
    """A display and what it writes to."""
    stream = io.StringIO()
    console = Console(file=stream, force_terminal=terminal, force_interactive=terminal, width=80, color_system=None)
    return StageDisplay(console), stream


@pytest.fixture(autouse=True)
def soon(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(stage_display, "INTERVAL_S", 0.25)


def until_shown(words: str, stream: io.StringIO) -> None:
    end_s = time.monotonic() + 20.0
    while words not in stream.getvalue():
        assert time.monotonic() < end_s, stream.getvalue()
        time.sleep(0.01)


def test_nothing_is_shown_of_what_is_fast() -> None:
    for terminal in (True, False):
        stages, stream = display(terminal=terminal)
        with stages as stage:
            stage("reading")
        assert "reading" not in stream.getvalue()
        assert "\n" not in stream.getvalue()


def test_a_log_has_a_line_for_each_stage_that_lasts() -> None:
    stages, stream = display(terminal=False)
    stages._begun_s -= 6.7
    with stages as stage:
        stage("short")
        stage("reading [1]")
        until_shown("reading [1]", stream)
        stage("solving")
        until_shown("solving", stream)
    assert re.fullmatch(r"\[7 s\] reading \[1\]\n\[[78] s\] solving\n", stream.getvalue())


def test_a_log_says_that_a_long_stage_goes_on(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(stage_display, "SILENCE_S", 0.4)
    stages, stream = display(terminal=False)
    with stages as stage:
        stage("solving")
        until_shown("still solving", stream)
    assert re.fullmatch(r"\[\d s\] solving\n\[\d s\] still solving\n", stream.getvalue())


def test_a_terminal_has_a_spinner_that_goes_away() -> None:
    stages, stream = display(terminal=True)
    with stages as stage:
        stage("reading [1]")
        until_shown("reading [1]", stream)
        stage("solving")
        until_shown("solving", stream)
    written = stream.getvalue()
    assert "0:00:0" in written
    assert written.endswith("\x1b[2K")  # the line is erased


def test_an_error_ends_the_display() -> None:
    stages, stream = display(terminal=True)
    try:
        with stages as stage:
            stage("reading")
            until_shown("reading", stream)
            raise KeyError("expected")
    except KeyError:
        shown = stream.getvalue()
    time.sleep(2.0 * stage_display.INTERVAL_S)
    assert stream.getvalue() == shown


def test_a_stage_with_a_count_is_a_string() -> None:
    told: list[str] = []
    told.append(Counted("detecting: image", 240, 1004))  # what a callable of the user's gets
    assert told == ["detecting: image 240 of 1004"]
    assert "image 240" in f"{told[0]}"
    again = pickle.loads(pickle.dumps(told[0]))  # a user's callable may send it to another process
    assert isinstance(again, Counted)
    assert (again, again.what, again.done, again.total) == (told[0], "detecting: image", 240, 1004)


@pytest.mark.parametrize(
    ("seconds", "words"),
    [(0.1, "1 s"), (4.0, "4 s"), (31.0, "30 s"), (70.0, "1 min"), (1500.0, "25 min"), (5400.0, "1.5 h")],
)
def test_times_in_words(seconds: float, words: str) -> None:
    assert duration(seconds) == words


def test_the_time_left_is_from_what_this_run_did() -> None:
    pace = Pace(begun_s=100.0, begun_done=800)  # an earlier run did 800
    stage = Counted("detecting: image", 850, 1000)
    assert pace.rate(stage, 110.0) == pytest.approx(5.0)
    assert pace.left_s(stage, 110.0) == pytest.approx(30.0)
    assert pace.left_s(Counted("detecting: image", 800, 1000), 110.0) is None
    assert pace.left_s(Counted("detecting: image", 1000, 1000), 110.0) == 0.0
    assert share(Counted("images", 0, 0)) == 0.0


def test_a_log_has_few_lines_of_a_stage_that_counts(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(stage_display, "INTERVAL_S", 0.1)
    monkeypatch.setattr(stage_display, "SILENCE_S", 0.35)
    stages, stream = display(terminal=False)
    with stages as stage:
        for done in range(1, 201):
            stage(Counted("detecting: image", done, 1000))
            time.sleep(0.005)
    lines = stream.getvalue().splitlines()
    assert 2 <= len(lines) <= 10  # of 200 counts
    assert re.fullmatch(r"\[\d+ s\] detecting: image \d+ of 1000 \(\d+ %\), about \d+ s left", lines[-1])


def test_a_terminal_has_a_bar_and_the_time_left(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(stage_display, "INTERVAL_S", 0.05)
    stream = io.StringIO()
    stages = StageDisplay(Console(file=stream, force_terminal=True, force_interactive=True, width=120))
    with stages as stage:
        stage(Counted("detecting: image", 1, 40))
        time.sleep(0.2)
        stage(Counted("detecting: image", 10, 40))
        time.sleep(0.3)
    written = stream.getvalue()
    assert "detecting: image 10 of 40" in written
    assert "25 %" in written
    assert re.search(r"\d+/s, about \d+ s left", written)
