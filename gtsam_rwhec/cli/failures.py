"""How errors and warnings are printed: one message each, without a traceback."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from enum import IntEnum
from pathlib import Path
from typing import TextIO

import typer

import gtsam_rwhec as rw
from gtsam_rwhec.errors import (
    FetchError,
    FileFormatError,
    NotCertifiedWarning,
    NotUniqueWarning,
    RwhecError,
    RwhecWarning,
)
from gtsam_rwhec.files.terminal_text import printable
from gtsam_rwhec.files.whole_files import is_one_of, why_not_writable


@contextmanager
def failures_in_words() -> Iterator[None]:
    """Print this package's errors and warnings as messages, each message once.

    Raises `typer.Exit` with an `ExitStatus` after an error of this package. Other errors are faults of the program and
    keep their traceback.
    """
    # Imported here, because completion in a shell must start fast.
    from rich.text import Text

    from gtsam_rwhec.files.terminal import SafeConsole

    console = SafeConsole(stderr=True, soft_wrap=True)
    told: set[str] = set()
    with warnings.catch_warnings(action="always", category=RwhecWarning):
        in_python = warnings.showwarning

        def show(
            message: Warning | str,
            category: type[Warning],
            filename: str,
            lineno: int,
            file: TextIO | None = None,
            line: str | None = None,
        ) -> None:
            if issubclass(category, RwhecWarning):
                words = _indented(str(message))
                if words not in told:  # several passes over a log repeat a warning
                    told.add(words)
                    console.print(Text("Warning: ", style="bold yellow").append(words, style="not bold default"))
            else:
                in_python(message, category, filename, lineno, file, line)

        warnings.showwarning = show
        try:
            yield
        except RwhecError as error:
            console.print(Text("Error: ", style="bold red").append(_indented(str(error)), style="not bold default"))
            if error.page:
                console.print(f"More: {error.page}", style="dim", markup=False)
            status = ExitStatus.DOWNLOAD_FAILED if isinstance(error, FetchError) else ExitStatus.BAD_INPUT
            raise typer.Exit(status) from error
        except KeyboardInterrupt as error:
            console.print(" ".join(["Interrupted.", *map(_indented, getattr(error, "__notes__", ()))]), markup=False)
            raise typer.Exit(ExitStatus.INTERRUPTED) from error


def _indented(message: str) -> str:
    """A message with indented later lines, so that a name with a line break cannot look like a new message."""
    return printable(message).replace("\n", "\n  ")


@contextmanager
def said_in_the_report() -> Iterator[None]:
    """Hide the warnings that the report explains better: not certified, and not unique."""
    with warnings.catch_warnings(action="ignore", category=NotUniqueWarning):
        warnings.simplefilter("ignore", NotCertifiedWarning)
        yield


def check_output(output: Path | None, *inputs: Path) -> None:
    """Check before a long calculation that its output can be written and is not an input; else FileFormatError."""
    if output is None:
        return
    why = why_not_writable(output)
    if not why and is_one_of(output, inputs):
        why = "the command reads it; give the name of another file"
    if why:
        raise FileFormatError(f"{output} cannot be written: {why}.")


class ExitStatus(IntEnum):
    """Exit statuses of every subcommand."""

    DONE = CERTIFIED = 0
    """The command succeeded; the poses of a calibration may be used, with care or without. With a rig file: each of its
    sensors and targets has a pose that the measurements determine and agree to."""
    CHANGED = 1
    """``diff``, ``fleet watch``: something changed by more than chance. ``verify``: the old one no longer holds.
    ``accept``: it is off by more than the limit.
    ``fleet run``: a log or a robot failed, or the poses of one are not to be used."""
    BAD_INPUT = 2
    """An option, a file or a measurement cannot be used; the message says which."""
    NOT_UNIQUE = 3
    """The answer is certified, but the measurements do not determine every frame: do not use the poses. Or a target of
    the rig file has too few measurements for any to be checked: do not use its pose. ``accept``: not accepted yet.
    ``plan``: no poses lead to the wanted accuracy, or none are seen."""
    NOT_CERTIFIED = 4
    """The answer is not certified: a better answer may exist."""
    DOWNLOAD_FAILED = 5
    """No network, or not the expected files; complete files stay."""
    CONTRADICTED = 6
    """The measurements contradict the answer: they were misread, a stated size is wrong, most measurements of a frame
    are outliers, or a sensor, or a target of the rig file, has no measurement that agrees."""
    INTERRUPTED = 130
    """Ctrl-C."""


HELP = (
    "Exit status: 0 success, and the poses may be used; 1 diff, verify or fleet watch found a change, accept "
    "rejected, or some of a fleet failed; 2 bad input; 3 the measurements do not determine every frame, or accept "
    "needs more touches, or plan has no poses that lead to what is wanted; 4 not proven optimal; 5 download failed; 6 "
    "the measurements contradict the answer (misread, a wrong size, a sensor or a target without an answer); 130 "
    "interrupted."
)


def exit_status(judgement: rw.Judgement, *, of_rig: bool = False) -> ExitStatus:
    """0 if the poses may be used, with care or without; else the status of the most serious ground.

    With a rig file (``of_rig``) it is 0 only if the pose of each of its sensors and targets may be used.
    """
    ground = rw.Ground
    if judgement.verdict is not rw.Verdict.DO_NOT_USE:
        if of_rig and ground.TARGET_CONTRADICTED in judgement.grounds:
            return ExitStatus.CONTRADICTED
        if of_rig and ground.FEW_MEASUREMENTS in judgement.grounds:
            return ExitStatus.NOT_UNIQUE
        return ExitStatus.CERTIFIED
    status = {
        ground.NO_BOUND: ExitStatus.NOT_CERTIFIED,
        ground.NOT_CERTIFIED: ExitStatus.NOT_CERTIFIED,
        ground.NOT_UNIQUE: ExitStatus.NOT_UNIQUE,
        ground.NO_COVARIANCE: ExitStatus.NOT_UNIQUE,
        ground.KNOWN_TO_NOTHING: ExitStatus.NOT_UNIQUE,
    }
    return status.get(judgement.grounds[0], ExitStatus.CONTRADICTED)
