"""``gtsam-rwhec fleet watch``: what moved on each robot from night to night."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

import gtsam_rwhec as rw
from gtsam_rwhec.cli.exit_status import ExitStatus
from gtsam_rwhec.cli.failures import check_output
from gtsam_rwhec.files.atomic_write import write_atomically
from gtsam_rwhec.files.terminal_text import say, shown_path

#: Nights of one robot between two false alarms: 1 / ``rw.results.RATE``, which help must not bring in.
NIGHTS = 1000.0
#: The name of the standard output in the place of a file.
STANDARD_OUTPUT = "-"


def watch(
    runs: Annotated[
        list[str],
        typer.Argument(
            help="Folders that fleet run wrote, or their files of rows (fleet.json, fleet.parquet): paths or URLs. Of "
            "two calibrations of one robot at the same time, the one given last counts."
        ),
    ],
    nights_between_false_alarms: Annotated[
        float, typer.Option(help="A robot that nothing happens to has a false alarm in so many nights: 50 to 100,000.")
    ] = NIGHTS,
    since: Annotated[
        str | None, typer.Option(help="Only alarms from this day (UTC) on count: 2026-11-23.", show_default="all count")
    ] = None,
    stream: Annotated[
        str | None,
        typer.Option(
            help="A file that gets one event a line, as JSON for programs. - is the standard output; what people read "
            "then goes to standard error."
        ),
    ] = None,
    every_night: Annotated[
        bool, typer.Option("--every-night", help="The stream has a line for each night too.")
    ] = False,
    output: Annotated[
        Path | None, typer.Option("--output", "-o", help="An HTML file with the charts of the robots that changed.")
    ] = None,
) -> ExitStatus:
    """What moved on each robot over time, when, and which frame; exit status 1 if something did."""
    rate = rw.results.checked_rate(nights_between_false_alarms)
    since_ns = rw.fleet.day_ns_of(since)
    to_file = None if stream in (None, STANDARD_OUTPUT) else Path(str(stream))
    local = [Path(each) for each in runs if "://" not in each]
    for written in (output, to_file):
        check_output(written, *local)
    watched = rw.fleet.watch(rw.fleet.read_history(runs), rate)
    lines = rw.fleet.stream(watched, every_night=every_night)
    is_piped = stream == STANDARD_OUTPUT
    if is_piped:
        for line in lines:
            typer.echo(line)
    elif to_file is not None:
        write_atomically(to_file, "".join(f"{line}\n" for line in lines).encode())
    alarms = rw.fleet.alarm_lines(watched, since_ns)
    for words in (rw.fleet.verdict(watched, since_ns), *alarms, *rw.fleet.remarks(watched)):
        say(words, to_errors=is_piped)
    if output is not None:
        rw.fleet.write_watch_page(watched, output, since_ns)
    for file in (to_file, output):
        if file is not None:
            say(f"Written to {shown_path(file)}.", to_errors=True)
    if not watched.robots:
        return ExitStatus.BAD_INPUT
    return ExitStatus.CHANGED if alarms else ExitStatus.DONE
