"""``gtsam-rwhec diff``: what changed from one calibration to the next."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

import gtsam_rwhec as rw
from gtsam_rwhec.cli.exit_status import ExitStatus
from gtsam_rwhec.cli.failures import check_output
from gtsam_rwhec.cli.report import read_of
from gtsam_rwhec.errors import FileFormatError
from gtsam_rwhec.files.terminal_text import say, shown_path

#: As ``rw.results.LEVEL``, which help must not bring in.
LEVEL = 0.01
RESULT_HELP = "result.json, or the folder that calibrate wrote."
LevelOption = Annotated[
    float, typer.Option(help="How often it may say that something changed where nothing did: 0.01 is once in 100.")
]


PageOption = Annotated[
    Path | None, typer.Option("--output", "-o", help="An HTML file for the same as a page, which needs no network.")
]


def write_page_to(
    found: rw.results.Difference | rw.results.Verification, output: Path | None, compared: tuple[Path, Path]
) -> None:
    """Write the page, if one is asked for, and say so."""
    if output is not None:
        rw.report.write_changes(found, output, compared)
        say(f"Written to {shown_path(output)}.", to_errors=True)


def diff(
    old: Annotated[Path, typer.Argument(help=f"The old calibration: {RESULT_HELP}")],
    new: Annotated[Path, typer.Argument(help=f"The new calibration: {RESULT_HELP}")],
    level: LevelOption = LEVEL,
    frame: Annotated[
        list[str] | None,
        typer.Option(help="Test only this frame, most sharply; repeat the option for several.", show_default="all"),
    ] = None,
    clocks_may_change: Annotated[
        bool, typer.Option("--clocks-may-change", help="Do not test the time offsets of sensors.")
    ] = False,
    other_arm: Annotated[
        bool, typer.Option("--other-arm", help="The carriers' poses of NEW come from another arm or tracker.")
    ] = False,
    output: PageOption = None,
) -> ExitStatus:
    """What moved from an old calibration to a new one, and whether by more than chance; exit status 1 if so."""
    check_output(output, *(file for each in (old, new) for file in read_of(each)))
    found = rw.results.difference(
        rw.results.read_calibration(old),
        rw.results.read_calibration(new),
        level=level,
        frames=frame or (),
        clocks_may_change=clocks_may_change,
        same_arm=not other_arm,
        same_measurements=have_same_inputs(old, new),
    )
    rw.report.print_difference(found)
    write_page_to(found, output, (old, new))
    if found.test is None and not found.is_same:
        return ExitStatus.BAD_INPUT
    return ExitStatus.CHANGED if found.has_changed else ExitStatus.DONE


def have_same_inputs(old: Path, new: Path) -> bool:
    """Whether the evidence beside two results names input files with the same checksums."""
    first, second = map(old_checksums, (old, new))
    return bool(first) and first == second


def old_checksums(result: Path) -> set[str]:
    """Of the input files of a calibration; empty where nothing readable beside its result says them."""
    evidence = rw.results.evidence_path(rw.results.result_path(result))
    if not evidence.exists():
        return set()
    try:
        inputs = rw.results.read_evidence(evidence).inputs
    except FileFormatError:  # of another version: the numbers themselves are compared all the same
        return set()
    return set() if inputs is None else {file.sha256 for file in inputs.files}
