"""The page in headless Chromium: by mouse and keyboard, wide and narrow, light and dark."""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Iterator
from importlib.resources import files
from pathlib import Path
from typing import Any

import pytest
from browser import ARGUMENTS, Opened, chromium, screenshots
from places import CELL

from gtsam_rwhec.capture import Accuracy
from gtsam_rwhec.capture.live_server import PageServer
from gtsam_rwhec.capture.live_session import LiveOptions, Session, source_of
from gtsam_rwhec.rig import read_rig

pytestmark = pytest.mark.browser


@pytest.fixture(scope="module")
def looks(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return screenshots(tmp_path_factory)


@pytest.fixture(scope="module")
def address(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """The page of a session on a replayed log, which another thread runs."""
    rig, out = read_rig(CELL / "eye_to_hand.yaml"), tmp_path_factory.mktemp("live")
    started, addresses = threading.Event(), []

    async def run() -> None:
        source = source_of(str(CELL / "eye_to_hand.mcap"), rig, 0.5)
        session = Session(source, rig, out, LiveOptions(wanted=Accuracy(0.005, 0.8)))
        server = PageServer(session)
        addresses.append(server.address)
        started.set()
        await asyncio.gather(session.run(), server.serve())

    thread = threading.Thread(target=lambda: asyncio.run(run()), daemon=True)
    thread.start()
    assert started.wait(60)
    yield addresses[0]
    thread.join(120)  # the last test has stopped it
    assert not thread.is_alive()
    assert (out / "recorded.mcap").is_file()


def until(page: Any, condition: str) -> None:
    for _ in range(1200):
        if page.evaluate(condition):
            return
        page.wait_for_timeout(50)
    raise AssertionError(f"the page never came to {condition}: {page.inner_text('body')}")


def takes_are(count: int) -> str:
    return f"parseInt(document.querySelector('#count').textContent) === {count}"


def test_live_by_mouse_and_keyboard(address: str, looks: Path) -> None:
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=chromium(), args=ARGUMENTS)
        opened = Opened(browser.new_page(viewport={"width": 1280, "height": 900}))
        page = opened.page
        page.goto(address)
        until(page, "document.querySelectorAll('figure[data-drawn]').length === 2")
        page.click("[data-do=take]")
        until(page, takes_are(1))
        for count in (2, 3, 4):
            page.keyboard.press("t")
            until(page, takes_are(count))
        page.keyboard.press("u")
        until(page, takes_are(3))
        page.keyboard.press("w")
        until(page, "document.querySelector('[data-do=when_still]').ariaPressed === 'true'")
        page.click("[data-do=when_still]")
        until(page, "document.querySelector('[data-do=when_still]').ariaPressed === 'false'")
        until(page, "document.querySelector('.age').textContent.startsWith('From 3 takes')")
        until(page, "document.querySelectorAll('#determines tbody tr, #determines tr').length === 2")
        for width, scheme in ((1280, "light"), (390, "dark")):
            page.set_viewport_size({"width": width, "height": 900})
            page.emulate_media(color_scheme=scheme)
            opened.photograph(looks, f"live-{width}-{scheme}")
            assert page.evaluate("document.documentElement.scrollWidth") <= width
        page.evaluate(files("axe_playwright_python").joinpath("axe.min.js").read_text(encoding="utf-8"))
        found = page.evaluate("axe.run({ resultTypes: ['violations'] })")
        bad = [(one["id"], one["help"]) for one in found["violations"] if one["impact"] in ("serious", "critical")]
        assert bad == []
        second = browser.new_page()
        second.goto(address)
        until(second, takes_are(3))
        page.click("[data-do=stop]")
        for each in (page, second):
            until(each, "document.querySelector('#banner').textContent.includes('has ended')")
        own = address.rpartition("/")[0].rpartition("/")[0]
        assert [one for one in opened.complaints if own not in one] == []
        browser.close()
