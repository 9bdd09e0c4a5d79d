"""``gtsam-rwhec fleet run``: every robot of a fleet, from its logs to its calibration."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Annotated, Literal

import typer

import gtsam_rwhec as rw
from gtsam_rwhec.cli.failures import ExitStatus, check_output, said_in_the_report
from gtsam_rwhec.cli.stage_display import StageDisplay
from gtsam_rwhec.files.terminal_text import say, shown_path
from gtsam_rwhec.files.whole_files import write_atomically

Each = Literal["robot", "day", "log"]
WORK_PANEL = "Who does the work"


def run(
    manifest: Annotated[
        str,
        typer.Argument(
            help="Manifest (YAML) of robots with their logs, or a pattern of logs with --rig, such as "
            "'s3://logs/*/*.mcap' (a robot has the name of its logs' folder). Paths, or URLs of fsspec."
        ),
    ],
    output: Annotated[str, typer.Option("--output", "-o", help="Folder or URL for all results. It is made.")],
    rig: Annotated[
        str | None, typer.Option(help="With a pattern: the rig file of all robots, a path or a URL.")
    ] = None,
    each: Annotated[
        Each, typer.Option(help="What is solved together: all logs of a robot, those of a day (UTC), or each alone.")
    ] = "robot",
    workers: Annotated[
        int | None,
        typer.Option(
            min=0,
            show_default="one for each core",
            rich_help_panel=WORK_PANEL,
            help="Processes of this machine. 0: this process alone.",
        ),
    ] = None,
    scheduler: Annotated[
        str | None, typer.Option(rich_help_panel=WORK_PANEL, help="Address of a Dask scheduler that runs.")
    ] = None,
    memory_per_worker: Annotated[
        str, typer.Option(rich_help_panel=WORK_PANEL, help="Memory that a worker may take, such as 2GB.")
    ] = "2GB",
) -> ExitStatus:
    """Calibrate every robot of a fleet; print the verdicts, the worst robots and what failed.

    What an earlier run did is not done again. One log's failure is a row of the report; exit status 1 says that
    something failed, or that poses are not to be used.
    """
    memory_bytes = rw.fleet.bytes_of(memory_per_worker)
    is_pattern = rw.fleet.is_pattern(manifest)
    if is_pattern != (rig is not None):
        needed = "a pattern of logs needs --rig FILE" if is_pattern else "--rig goes with a pattern of logs"
        raise typer.BadParameter(f"{needed}; a manifest names its rig files itself")
    count = (os.cpu_count() or 1) if workers is None else workers
    with StageDisplay() as stage, said_in_the_report():
        stage(f"reading {rw.fleet.shown(manifest)}")
        fleet = rw.fleet.manifest_of_pattern(manifest, rig) if rig is not None else rw.fleet.read_manifest(manifest)
        if count == 0 and scheduler is None:
            done = rw.fleet.run(fleet, output, each, progress=stage)
        else:
            with rw.fleet.DaskEngine(count, memory_bytes, scheduler, progress=stage) as engine:
                done = rw.fleet.run(fleet, output, each, engine, stage)
    rw.fleet.print_fleet(done)
    say(f"The page of all robots: {rw.fleet.shown(rw.fleet.put_page(done.rows, output))}", to_errors=True)
    return ExitStatus.DONE if done.is_fine else ExitStatus.CHANGED


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
        Path | None, typer.Option("--output", "-o", help="A page (HTML): all calibrations, what moved, with charts.")
    ] = None,
) -> ExitStatus:
    """What moved on each robot over time, when, and which frame; exit status 1 if something did."""
    rate = rw.results.checked_rate(nights_between_false_alarms)
    since_ns = rw.fleet.day_ns_of(since)
    to_file = None if stream in (None, STANDARD_OUTPUT) else Path(str(stream))
    local = [Path(each) for each in runs if "://" not in each]
    for written in (output, to_file):
        check_output(written, *local)
    rows = rw.fleet.read_history(runs)
    watched = rw.fleet.watch(rows, rate)
    lines = rw.fleet.stream(watched, every_night=every_night)
    is_piped = stream == STANDARD_OUTPUT
    if is_piped:
        for line in lines:
            typer.echo(line)
    elif to_file is not None:
        write_atomically(to_file, "".join(f"{line}\n" for line in lines).encode())
    alarms = rw.fleet.alarm_lines(watched, since_ns)
    for words in (rw.fleet.drift_verdict(watched, since_ns), *alarms, *rw.fleet.drift_remarks(watched)):
        say(words, to_errors=is_piped)
    if output is not None:
        rw.fleet.write_fleet_page(rows, watched, output, since_ns)
    for file in (to_file, output):
        if file is not None:
            say(f"Written to {shown_path(file)}.", to_errors=True)
    if not watched.robots:
        return ExitStatus.BAD_INPUT
    return ExitStatus.CHANGED if alarms else ExitStatus.DONE
