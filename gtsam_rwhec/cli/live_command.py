"""``gtsam-rwhec live``: take, see and calibrate while the robot stands there."""

from __future__ import annotations

import asyncio
import webbrowser
from contextlib import suppress
from pathlib import Path
from typing import Annotated

import typer

import gtsam_rwhec as rw
from gtsam_rwhec.cli.failures import ExitStatus, exit_status, said_in_the_report
from gtsam_rwhec.files.terminal_text import say, shown_path


def live(
    source: Annotated[
        str,
        typer.Argument(
            help="ws://HOST:8765 (foxglove_bridge), an MCAP file that a recorder writes, one to replay, a folder "
            "that images and poses fall into, or camera:0, a camera of this machine beside --poses."
        ),
    ],
    rig: Annotated[Path, typer.Option("--rig", help="Rig file (YAML).")],
    output: Annotated[
        Path,
        typer.Option(
            "--output", "-o", help="Folder for takes, log and calibration. One with takes in it is gone on with."
        ),
    ],
    speed: Annotated[
        float | None, typer.Option(min=0.01, help="Replay the log so many times as fast as it was recorded.")
    ] = None,
    wanted_mm: Annotated[
        float | None, typer.Option(min=1e-6, help="Wanted: a point in front of each camera within so many millimetres.")
    ] = None,
    at_m: Annotated[float, typer.Option(min=1e-3, help="The distance of this point, metres.")] = 0.8,
    when_still: Annotated[
        bool, typer.Option("--when-still", help="Take by itself wherever the robot stands still at a new pose.")
    ] = False,
    poses: Annotated[
        str,
        typer.Option(help="Beside camera:0: a file that poses are written to, a line each; -: they are typed here."),
    ] = "-",
    publish: Annotated[str, typer.Option(help="Topic on which the next pose is proposed, with ws://... only.")] = "",
    host: Annotated[str, typer.Option(help="Address of this machine on which the page is served.")] = "127.0.0.1",
    port: Annotated[int, typer.Option(min=0, max=65535, help="Port of the page.", show_default="a free one")] = 0,
    browser: Annotated[bool, typer.Option("--browser/--no-browser", help="Open the page in a browser.")] = True,
    terminal: Annotated[bool, typer.Option("--terminal", help="Show everything here, and serve no page.")] = False,
) -> ExitStatus:
    """Look at what the cameras see, take, and see at once how good the calibration is; save what calibrate writes.

    The folder gets recorded.mcap, rig.yaml and calibration/, which is what calibrate writes for the two. The robot is
    not moved: poses are proposed.
    """
    described = rw.rig.read_rig(rig)
    wanted = None if wanted_mm is None else rw.Accuracy(1e-3 * wanted_mm, at_m)
    options = rw.capture.LiveOptions(wanted=wanted, takes_when_still=when_still, publish=publish)
    session = rw.capture.Session(rw.capture.source_of(source, described, speed, poses), described, output, options)
    server = None if terminal else rw.capture.PageServer(session, host, port)
    if server is not None:
        say(f"The page: {server.address}", to_errors=True)
        if browser:
            webbrowser.open(server.address)
    try:
        with said_in_the_report():
            asyncio.run(_together(session, server, draws=terminal))
    except KeyboardInterrupt as error:
        error.add_note(f"The takes are in {shown_path(output)}; the same command goes on with them.")
        raise
    if session.judgement is None:
        say(f"No calibration was saved. {_why_none(session)}", to_errors=True)
        return ExitStatus.NOT_UNIQUE
    say(f"{session.judgement}\nWritten to {shown_path(output)}.")
    return exit_status(session.judgement, of_rig=True)


async def _together(session: rw.capture.Session, server: rw.capture.PageServer | None, *, draws: bool) -> None:
    """Run the session and what shows it, until one of them ends or fails."""
    from gtsam_rwhec.files.terminal import SafeConsole

    work = [session.run(), rw.capture.show_on_terminal(session, SafeConsole(stderr=True), draws=draws)]
    tasks = [asyncio.create_task(each) for each in (*work, *([] if server is None else [server.serve()]))]
    try:
        await asyncio.wait(tasks, return_when=asyncio.FIRST_EXCEPTION)
        for task in tasks:
            if task.done():
                task.result()
    finally:
        for task in tasks:
            task.cancel()
        with suppress(asyncio.CancelledError):
            await asyncio.gather(*tasks, return_exceptions=True)


def _why_none(session: rw.capture.Session) -> str:
    """What a session without a calibration has left, and what to do."""
    if session.takes.all:
        return f"The takes are in {shown_path(session.takes.folder)}; the same command goes on with them."
    if session.options.takes_when_still:
        return (
            "Nothing was taken: the robot never stood still where a target is seen. Stop it at each pose, or press T."
        )
    return "Nothing was taken: press T on the page, or give --when-still."
