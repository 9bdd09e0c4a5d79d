"""The progress display, on terminals and in logs."""

from __future__ import annotations

import io
import time

import pytest
from rich.console import Console

from gtsam_rwhec.cli import stage_display
from gtsam_rwhec.cli.stage_display import INTERVAL_S, StageDisplay


def display(*, terminal: bool) -> tuple[StageDisplay, io.StringIO]:
    """A display and what it writes to."""
    stream = io.StringIO()
    console = Console(file=stream, force_terminal=terminal, force_interactive=terminal, width=80, color_system=None)
    return StageDisplay(console), stream


def test_nothing_is_shown_of_what_is_fast() -> None:
    for terminal in (True, False):
        stages, stream = display(terminal=terminal)
        with stages as stage:
            stage("reading")
        assert "reading" not in stream.getvalue()
        assert "\n" not in stream.getvalue()


def test_a_log_has_a_line_for_each_stage_that_lasts() -> None:
    stages, stream = display(terminal=False)
    with stages as stage:
        stage("short")
        stage("reading [1]")
        time.sleep(2.4 * INTERVAL_S)
        stage("solving")
        time.sleep(1.2 * INTERVAL_S)
    assert stream.getvalue().splitlines() == ["[1 s] reading [1]", "[3 s] solving"]


def test_a_log_says_that_a_long_stage_goes_on(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(stage_display, "SILENCE_S", 1.5 * INTERVAL_S)
    stages, stream = display(terminal=False)
    with stages as stage:
        stage("solving")
        time.sleep(3.5 * INTERVAL_S)
    assert stream.getvalue().splitlines() == ["[1 s] solving", "[3 s] still solving"]


def test_a_terminal_has_a_spinner_that_goes_away() -> None:
    stages, stream = display(terminal=True)
    with stages as stage:
        stage("reading [1]")
        time.sleep(1.5 * INTERVAL_S)
        stage("solving")
        time.sleep(0.3 * INTERVAL_S)
    written = stream.getvalue()
    assert "reading [1]" in written
    assert "solving" in written
    assert "0:00:01" in written
    assert written.endswith("\x1b[2K")  # the line is erased


def test_an_error_ends_the_display() -> None:
    stages, stream = display(terminal=True)
    try:
        with stages as stage:
            stage("reading")
            time.sleep(1.2 * INTERVAL_S)
            raise KeyError("expected")
    except KeyError:
        shown = stream.getvalue()
    time.sleep(1.2 * INTERVAL_S)
    assert stream.getvalue() == shown
