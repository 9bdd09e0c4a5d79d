"""How errors and warnings are printed: one message each, without a traceback."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TextIO

import typer

from gtsam_rwhec.cli.exit_status import ExitStatus
from gtsam_rwhec.errors import (
    FetchError,
    FileFormatError,
    NotCertifiedWarning,
    NotUniqueWarning,
    RwhecError,
    RwhecWarning,
)
from gtsam_rwhec.files.atomic_write import why_not_writable
from gtsam_rwhec.files.paths import is_one_of
from gtsam_rwhec.files.terminal_text import printable


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
    with warnings.catch_warnings():
        warnings.simplefilter("always", RwhecWarning)
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
    """A message whose later lines are indented, so that no name with a line break begins a message of its own."""
    return printable(message).replace("\n", "\n  ")


@contextmanager
def said_in_the_report() -> Iterator[None]:
    """Hide the warnings that the report explains better: not certified, and not unique."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", NotUniqueWarning)
        warnings.simplefilter("ignore", NotCertifiedWarning)
        yield


def check_output(output: Path | None, *inputs: Path) -> None:
    """Check before a long calculation that its result can be written, and not onto an input; else FileFormatError."""
    if output is None:
        return
    why = why_not_writable(output)
    if not why and is_one_of(output, inputs):
        why = "the command reads it; give the name of another file"
    if why:
        raise FileFormatError(f"{output} cannot be written: {why}.")
