"""A session from end to end: a server of Foxglove's SDK, the command, and its page in headless Chromium.

    python benchmarks/live_replay.py [--seconds 60] [--kills 50] [--seed 0] [--screenshots FOLDER]

The shipped log is sent at ten images a second and camera, again and again, with stamps of now; the command runs as
people start it. The page is used by mouse and keyboard. Then: is everything counted, how old are detections when they
are drawn, does ``calibrate`` on the recorded log give the same result, what is left of sessions that are killed at
random, and what is said when the disk is full.
"""

from __future__ import annotations

import json
import multiprocessing
import os
import random
import re
import resource
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager, suppress
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import numpy as np
from bars import Row, at_most, run_script
from browser import ARGUMENTS, chromium
from foxglove_robot import Robot, messages_of
from places import CELL
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect

from gtsam_rwhec.capture.live_takes import Takes
from gtsam_rwhec.errors import LogError
from gtsam_rwhec.logs import open_log

RIG = CELL / "rig.yaml"
IMAGES = ("/cam_left/image", "/cam_wide/image")
#: The log has 60 images of each camera in 31 s: so many times faster are ten a second.
SPEED = 10.0 * 31.0 / 60.0
#: Takes of the session.
MOST_TAKES = 8
#: Seconds of everything that is waited for.
PATIENCE_S = 300.0
#: Every age of a picture when it is drawn, and since its image was received, milliseconds.
AGES = """() => {
  window.ages = [];
  new MutationObserver((all) => { for (const { target } of all)
    window.ages.push([target.querySelector("b").textContent, +target.dataset.age, +target.dataset.late]);
  }).observe(document.querySelector("#cameras"), { subtree: true, attributes: true, attributeFilter: ["data-drawn"] });
}"""


def robot(told: Connection) -> None:
    """The robot's process: it sends while nobody says stop, and then how many images it sent."""
    with Robot(messages_of(CELL / "robot_cell.mcap")) as server:
        told.send(server.port)
        server.wait_for_subscriptions(IMAGES, PATIENCE_S)
        stop = threading.Event()
        sending = threading.Thread(
            target=lambda: [server.send(SPEED, as_now=True, stop=stop) for _ in iter(stop.is_set, True)]
        )
        sending.start()
        while True:
            if told.recv() == "how many":
                stop.set()
                sending.join()
                told.send({topic: server.sent[topic] for topic in IMAGES})
            else:
                return


@contextmanager
def running_robot() -> Iterator[tuple[int, Connection]]:
    """The port of a robot, and the connection to its process."""
    mine, its = multiprocessing.Pipe()
    process = multiprocessing.get_context("spawn").Process(target=robot, args=(its,), daemon=True)
    process.start()
    try:
        yield mine.recv(), mine
    finally:
        process.kill()
        process.join()


class Command(AbstractContextManager["Command"]):
    """``gtsam-rwhec live`` as a process of its own, with the address of its page."""

    def __init__(self, source: str, out: Path, *options: str, rig: Path = RIG, most_bytes: int | None = None) -> None:
        def limited() -> None:
            if most_bytes is not None:
                resource.setrlimit(resource.RLIMIT_FSIZE, (most_bytes, most_bytes))

        words = [sys.executable, "-m", "gtsam_rwhec", "live", source, "--rig", str(rig), "-o", str(out)]
        self.process = subprocess.Popen(
            [*words, "--no-browser", *options], stderr=subprocess.PIPE, stdout=subprocess.PIPE, text=True,
            preexec_fn=limited, start_new_session=True,
        )  # fmt: skip
        assert self.process.stderr is not None
        self.said: list[str] = []
        line = self.process.stderr.readline()
        found = re.search(r"http://\S+", line)
        assert found is not None, line + self.process.stderr.read()
        self.address = found[0]
        threading.Thread(target=lambda: self.said.extend(self.process.stderr), daemon=True).start()  # type: ignore[arg-type]

    @property
    def socket(self) -> Any:
        """A connection as the page has it."""
        where = self.address.removeprefix("http://")
        return connect(f"ws://{where}socket", origin=f"http://{where.partition('/')[0]}", max_size=None, proxy=None)

    def kill(self) -> None:
        """SIGKILL to it and to all that it started."""
        with suppress(ProcessLookupError):
            os.killpg(self.process.pid, signal.SIGKILL)
        self.process.wait()

    def __exit__(self, *raised: object) -> None:
        self.kill()


def looked_at(page: Any, folder: Path | None, name: str) -> None:
    """Screenshots: wide and narrow, light and dark."""
    if folder is None:
        return
    for width, scheme in ((1280, "light"), (1280, "dark"), (390, "light"), (390, "dark")):
        page.set_viewport_size({"width": width, "height": 900})
        page.emulate_media(color_scheme=scheme)
        page.wait_for_timeout(400)
        page.screenshot(path=folder / f"live-{name}-{width}-{scheme}.png", full_page=True)
    page.set_viewport_size({"width": 1280, "height": 900})


def until(page: Any, condition: str) -> bool:
    """Wait until a page fulfils a condition. Playwright's own waiting needs eval, which the page forbids."""
    until_s = time.monotonic() + PATIENCE_S
    while not page.evaluate(condition):
        if time.monotonic() > until_s:
            print(f"the page never came to {condition}:\n{page.inner_text('body')}", file=sys.stderr)
            return False
        page.wait_for_timeout(50)
    return True


def count_is(page: Any, count: int) -> bool:
    """Whether the page comes to show so many takes."""
    return until(page, f"parseInt(document.querySelector('#count').textContent) === {count}")


def session(seconds: float, folder: Path, shots: Path | None) -> list[Row]:
    """A whole session by mouse and keyboard."""
    from playwright.sync_api import sync_playwright

    out, rig = folder / "session", folder / "rig.yaml"
    # This robot never stands still, and so few images do not always tell the clocks: they are stated, as fast as it is.
    text = RIG.read_text(encoding="utf-8")
    for offset_s in json.loads((CELL / "truth.json").read_text(encoding="utf-8"))["time_offset_s"].values():
        text = text.replace("time_offset: estimate", f"time_offset: {offset_s / SPEED:.6f}", 1)
    rig.write_text(text, encoding="utf-8")
    with (
        running_robot() as (port, its),
        Command(f"ws://127.0.0.1:{port}", out, "--wanted-mm", "1.5", rig=rig) as command,
        sync_playwright() as playwright,
    ):
        browser = playwright.chromium.launch(executable_path=chromium(), args=ARGUMENTS)
        page = browser.new_page(viewport={"width": 1280, "height": 900})
        complaints: list[str] = []
        page.on("console", lambda message: complaints.append(message.text) if message.type == "error" else None)
        page.on("pageerror", lambda error: complaints.append(str(error)))
        page.goto(command.address)
        page.wait_for_selector("figure[data-drawn]", timeout=1e3 * PATIENCE_S)
        page.evaluate(AGES)
        worked = {}
        page.click("[data-do=take]")
        worked["take by mouse"] = count_is(page, 1)
        page.keyboard.press("t")
        worked["take by keyboard"] = count_is(page, 2)
        page.click("[data-do=undo]")
        worked["undo by mouse"] = count_is(page, 1)
        page.keyboard.press("u")
        worked["undo by keyboard"] = count_is(page, 0)
        looked_at(page, shots, "empty")
        begun_s, taken = time.monotonic(), 0
        while taken < MOST_TAKES or time.monotonic() - begun_s < seconds:
            page.wait_for_timeout(700)
            if taken < MOST_TAKES:
                page.keyboard.press("t")
                taken += 1
                count_is(page, taken)
        until(page, f"document.querySelector('.age').textContent.startsWith('From {MOST_TAKES} ')")
        looked_at(page, shots, "answered")
        page.click("[data-do=save]")
        saved = "document.querySelector('#count').textContent.endsWith('saved')"
        until(page, saved)
        worked["save by mouse"] = (out / "calibration" / "result.json").is_file()
        before = (out / "calibration" / "result.json").stat().st_mtime_ns
        page.keyboard.press("s")
        page.wait_for_timeout(500)
        until(page, "document.querySelector('#banner').hidden")
        worked["save by keyboard"] = (out / "calibration" / "result.json").stat().st_mtime_ns > before
        ages = page.evaluate("window.ages")
        its.send("how many")
        sent = its.recv()
        page.wait_for_timeout(2000)
        cameras = page.evaluate("[...document.querySelectorAll('.counts')].map((each) => each.textContent)")
        page.click("[data-do=stop]")
        until(page, "document.querySelector('#banner').textContent.includes('ended')")
        status = command.process.wait(PATIENCE_S)
        worked["stop by mouse"] = status in (0, 6)
        browser.close()
    numbers = [list(map(int, re.findall(r"\d+", words))) for words in cameras]
    received = [came for came, *_ in numbers]
    missing = sum(sent.values()) - sum(received)
    uncounted = sum(came - looked - skipped for came, looked, skipped in numbers)
    age, late = (np.percentile([each[place] for each in ages], [50, 99]) for place in (1, 2))
    share = sum(looked for _, looked, _ in numbers) / max(sum(received), 1)
    rows = [
        at_most(
            "images that the robot sent and the session did not receive", missing, 0, more=f" of {sum(sent.values())}"
        ),
        at_most("images received, and neither searched nor counted as passed over", uncounted, 0),
        Row("share of the images that was searched", f"{100 * share:.0f} %"),
        at_most(
            "detection to page, 99 %", age[1], 300.0, " ms", ".0f", f" (median {age[0]:.0f}, {len(ages)} pictures)"
        ),
        Row("image received to page, median and 99 %", f"{late[0]:.0f} and {late[1]:.0f} ms"),
        at_most("complaints of the browser", len(complaints), 0, more=f" {complaints[:2]}" if complaints else ""),
        *(Row(what, "yes" if did else "no", "yes", did) for what, did in worked.items()),
    ]
    return [*rows, same_as_command(out, folder / "again")]


def timeless(content: Any) -> Any:
    """A result without the seconds that its proof took."""
    if isinstance(content, dict):
        return {name: timeless(each) for name, each in content.items() if name != "seconds"}
    return list(map(timeless, content)) if isinstance(content, list) else content


def same_as_command(out: Path, again: Path) -> Row:
    """Whether ``calibrate`` on the recorded log gives the same result file, to the last bit."""
    words = [
        sys.executable,
        "-m",
        "gtsam_rwhec",
        "calibrate",
        out / "recorded.mcap",
        "--rig",
        out / "rig.yaml",
        "-o",
        again,
    ]
    subprocess.run(list(map(str, words)), capture_output=True, check=False)
    one, other = (timeless(json.loads((each / "result.json").read_text())) for each in (out / "calibration", again))
    is_same = one == other
    return Row("the result equals that of calibrate on the recorded log", "yes" if is_same else "no", "yes", is_same)


def killed(number: int, chance: random.Random, folder: Path) -> tuple[int, str]:
    """Takes that were shown before a kill at random, and are not in the log; and what could not be read."""
    out = folder / f"killed-{number}"
    command = Command(str(CELL / "robot_cell.mcap"), out, "--speed", "8")
    shown, until_s = 0, time.monotonic() + chance.uniform(0.5, 6.0)
    killer = threading.Timer(until_s - time.monotonic(), command.kill)
    killer.start()
    try:
        with command.socket as page:
            while True:
                page.send('{"do": "take"}')
                said = page.recv()
                if isinstance(said, str) and "takes" in (state := json.loads(said)):
                    shown = state["takes"]["count"]
    except (OSError, EOFError, ConnectionClosed):
        killer.join()
    command.process.wait()
    takes = sorted((out / "takes").glob("*.mcap")) if out.is_dir() else []
    try:
        images = 0
        if takes:
            with open_log(takes) as log:
                images = sum(
                    1 for _ in log.records(set(IMAGES) & {topic.name for topic in log.topics()}, on_bad="raise")
                )
                if log.losses or images < len(takes):
                    return shown - len(takes), f"{log.losses}, {images} images in {len(takes)} takes"
        return max(0, shown - len(takes)), ""
    except LogError as error:
        return max(0, shown - len(takes)), str(error)
    finally:
        shutil.rmtree(out, ignore_errors=True)
        print(f"killed {number + 1}: {shown} takes were shown, {len(takes)} are in the log", file=sys.stderr)


def killed_writing(kills: int, chance: random.Random, folder: Path) -> list[Row]:
    """The writer alone, killed while it writes one take after the other: most kills are in the middle of one."""
    messages = [(message.received_ns, message) for message in messages_of(CELL / "robot_cell.mcap")[:120]]
    lost = unread = middle = total = 0
    for number in range(kills):
        out, (told, tell) = folder / f"writing-{number}", os.pipe()
        writer = os.fork()
        if not writer:
            takes = Takes(out)
            while True:
                takes.add(messages, {}, len(takes.all) + 1, is_still=True)
                os.write(tell, b"x")
        os.close(tell)
        time.sleep(chance.uniform(0.02, 0.4))
        os.kill(writer, signal.SIGKILL)
        os.waitpid(writer, 0)
        told_of = len(os.read(told, 1 << 20))
        os.close(told)
        middle += any((out / "takes").glob(".*.part"))
        left = Takes(out).all
        lost, total = lost + max(0, told_of - len(left)), total + len(left)
        for take in left:
            with open_log(take.path) as log:
                unread += bool(log.losses) or sum(1 for _ in log.records(on_bad="raise")) < len(messages) // 2
        shutil.rmtree(out)
    more = f" of {total}, {kills} kills, {middle} in the middle of a take"
    return [
        at_most("takes that were written and are lost", lost, 0, more=more),
        at_most("takes that cannot be read", unread, 0),
    ]


def full_disk(folder: Path) -> list[Row]:
    """What is said where the disk takes no more."""
    command = Command(str(CELL / "robot_cell.mcap"), folder / "full", "--speed", "2", most_bytes=30_000)
    words, state = "", {}
    try:
        with command.socket as page:
            until_s = time.monotonic() + 20.0
            while not words and time.monotonic() < until_s:
                page.send('{"do": "take"}')
                said = page.recv()
                if isinstance(said, str) and "said" in (state := json.loads(said)):
                    words = next((each for _, kind, each in state["said"] if kind == "bad"), "")
            time.sleep(1.0)
            is_alive = command.process.poll() is None
    finally:
        command.kill()
    left = [path.name for path in (folder / "full" / "takes").glob("*.mcap")]
    is_said = "cannot be written" in words and is_alive and not left
    return [Row(f"disk full: {words}", "yes" if is_said else "no", "said, and goes on", is_said)]


def rows(seconds: float, kills: int, seed: int, screenshots: str) -> list[Row]:
    """The bars of issue 28, section Live."""
    shots = Path(screenshots) if screenshots else None
    if shots is not None:
        shots.mkdir(parents=True, exist_ok=True)
    chance = random.Random(seed)
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        found = session(seconds, folder, shots) if seconds else []
        left = [killed(number, chance, folder) for number in range(kills)]
        if kills:
            lost, faults = sum(each for each, _ in left), [words for _, words in left if words]
            found += [
                at_most("takes that were shown and are lost", lost, 0, more=f", killed {kills} times"),
                at_most("recorded logs that cannot be read", len(faults), 0, more=f" {faults[:2]}" if faults else ""),
            ]
            found += killed_writing(4 * kills, chance, folder)
        return [*found, *full_disk(folder)]


if __name__ == "__main__":
    run_script("Live", rows, seconds=60.0, kills=50, seed=0, screenshots="")
