"""A session on a terminal, without a browser: the same state as a table that is drawn anew, and the same keys."""

from __future__ import annotations

import asyncio
import os
import sys
import termios
import tty
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from rich.console import Console, Group, RenderableType
from rich.live import Live
from rich.table import Table
from rich.text import Text

from gtsam_rwhec.capture.live_session import COMMANDS, Session
from gtsam_rwhec.errors import RwhecError
from gtsam_rwhec.files.terminal_text import rounded

#: Seconds between two drawings, and the last things that happened that are shown.
DRAWN_S, SHOWN = 0.25, 6
#: Styles of what happened, and of the verdict.
STYLES = {"good": "green", "bad": "bold red", "use": "bold green", "care": "bold yellow", "do_not_use": "bold red"}


async def show_on_terminal(session: Session, console: Console, *, draws: bool) -> None:
    """Show a session until it ends; keys are read where standard input is a terminal.

    Parameters
    ----------
    session : Session
    console : Console
    draws : bool
        Draw the state anew and anew; else print what happens, a line each: for logs, and beside a page.
    """
    told = 0
    with _keys(session), Live(console=console, auto_refresh=False, transient=True) as live:
        while True:
            state = session.state()
            happened = state["said"][::-1]
            new = happened[-(session.said_count - told) :] if session.said_count > told else []
            told = session.said_count
            for at, kind, words in new:
                live.console.print(Text(f"{at} {words}", STYLES.get(kind, "")))
            if draws and console.is_terminal:
                live.update(drawn(state), refresh=True)
            if session.ended:
                return
            await asyncio.sleep(DRAWN_S)


def drawn(state: dict[str, Any]) -> RenderableType:
    """The state of a session, for a terminal."""
    answer, takes = state["answer"], state["takes"]
    head = Text(f"{state['source']['name']}: {state['source']['state']}. ")
    head.append(state["still"]["words"], "green" if state["still"]["is_still"] else "")
    table = Table(expand=True)
    for name in ("camera", "sees", "came", "searched", "passed over", "image with corners"):
        table.add_column(name, justify="left" if name in ("camera", "sees") else "right")
    for camera in state["cameras"]:
        seen = ", ".join(f"{name}: {why}" if why else name for name, why in camera["targets"].items())
        cells = [count for row in (answer or {}).get("cells", {}).get(camera["name"], ()) for count in row]
        share = f"{100 * sum(map(bool, cells)) / len(cells):.0f} %" if cells else "-"
        counts = (str(camera[name]) for name in ("received", "looked", "skipped"))
        table.add_row(camera["name"], camera["fault"] or seen or "no target", *counts, share)
    lines: list[RenderableType] = [head, table]
    words = f"{takes['count']} takes{', saved' if takes['count'] and takes['is_saved'] else ''}"
    words += "; takes when the robot stands still" if takes["when_still"] else ""
    lines.append(Text(f"{words}. {state['busy']}"))
    if answer is not None:
        lines.append(
            Text(
                ": ".join(filter(None, (state["verdict"], answer["reason"] or answer["why_none"]))),
                STYLES.get(answer["verdict"], ""),
            )
        )
        wanted = f", wanted {1e3 * state['wanted']['radius_m']:g} mm" if state["wanted"] else ""
        for one in answer["points"]:
            is_known = one["radius_mm"] < float("inf")
            off = f"within {rounded(one['radius_mm'])} mm" if is_known else "not determined"
            lines.append(Text(f"{one['sensor']}: a point {one['distance_m']:.2f} m away {off}{wanted}"))
        lines += [Text(words, "bold red") for words in answer["free"]]
        lines += [Text(answer[what]["words"]) for what in ("proposal", "decision") if answer[what]]
    lines += [Text(words, "bold red") for words in state["troubles"]]
    lines += [Text(words, "dim") for words in state["counted"]]
    lines += [Text(f"{at} {words}", STYLES.get(kind, "")) for at, kind, words in state["said"][:SHOWN]]
    lines.append(Text("  ".join(f"[{key}] {name.replace('_', ' ')}" for name, key in COMMANDS.items()), "reverse"))
    return Group(*lines)


@contextmanager
def _keys(session: Session) -> Iterator[None]:
    """Let single keys be commands while the block runs, if standard input is a terminal."""
    if not (session.source.reads_keys and sys.stdin.isatty()):
        yield
        return
    descriptor, loop = sys.stdin.fileno(), asyncio.get_running_loop()
    before = termios.tcgetattr(descriptor)
    names = {key: name for name, key in COMMANDS.items()}
    asked: set[asyncio.Task[None]] = set()

    async def ask(name: str) -> None:
        try:
            await session.command(name)
        except RwhecError as error:
            session.say(str(error), "bad")

    def pressed() -> None:
        for key in os.read(descriptor, 100).decode(errors="replace").lower():
            if key in names:
                task = loop.create_task(ask(names[key]))
                asked.add(task)
                task.add_done_callback(asked.discard)

    tty.setcbreak(descriptor)
    loop.add_reader(descriptor, pressed)
    try:
        yield
    finally:
        loop.remove_reader(descriptor)
        termios.tcsetattr(descriptor, termios.TCSADRAIN, before)
