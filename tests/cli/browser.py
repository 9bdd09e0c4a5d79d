"""Chromium for the tests that look at reports: where it is, how it is started, and what it saves."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

HERE = Path(__file__).parent
#: Without a graphics card WebGL is computed, which Chromium calls unsafe for pages from the network.
ARGUMENTS = [
    "--no-sandbox",
    "--use-gl=angle",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    "--no-first-run",
]
NAMES = ("chromium", "chromium-browser", "google-chrome")
#: Pixels of the height of a screenshot.
PIECE = 2000
#: The page is ready when its scenes are drawn, or when it is known that they cannot be.
READY = "() => document.documentElement.dataset.scenes || !document.getElementById('plotly')"


def chromium() -> str:
    """The browser's program: the one that GTSAM_RWHEC_CHROMIUM names, or the system's."""
    found = os.environ.get("GTSAM_RWHEC_CHROMIUM") or next(filter(None, map(shutil.which, NAMES)), None)
    if found is None:
        pytest.fail("there is no Chromium: apt-get install chromium, or set GTSAM_RWHEC_CHROMIUM to its program")
    return found


def screenshots(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Where screenshots are kept: the folder that GTSAM_RWHEC_SCREENSHOTS names, or one of the test run."""
    named = os.environ.get("GTSAM_RWHEC_SCREENSHOTS")
    folder = Path(named) if named else tmp_path_factory.mktemp("screenshots")
    folder.mkdir(parents=True, exist_ok=True)
    return folder


class Opened:
    """A page in the browser, with everything that it complained of."""

    def __init__(self, page: Any) -> None:
        self.page = page
        self.complaints: list[str] = []
        page.on("console", self._heard)
        page.on("pageerror", lambda error: self.complaints.append(f"error: {error}"))
        page.on("request", self._asked)

    def _heard(self, message: Any) -> None:
        if message.type == "error":
            self.complaints.append(f"console: {message.text}")

    def _asked(self, request: Any) -> None:
        if not request.url.startswith(("file:", "data:", "blob:")):
            self.complaints.append(f"network: {request.url}")

    def photograph(self, folder: Path, name: str) -> None:
        """Save the page as NAME-1.png, NAME-2.png and so on: a browser has no picture of any height."""
        height = self.page.evaluate("document.documentElement.scrollHeight")
        width = self.page.viewport_size["width"]
        for number, top in enumerate(range(0, height, PIECE), start=1):
            clip = {"x": 0, "y": top, "width": width, "height": min(PIECE, height - top)}
            self.page.screenshot(path=folder / f"{name}-{number}.png", full_page=True, clip=clip)

    def wrong_layout(self) -> list[str]:
        """What is cut or overlaps."""
        return list(self.page.evaluate((HERE / "layout.js").read_text(encoding="utf-8")))


@contextmanager
def opened(browser: Any, path: Path, *, width: int = 1280, height: int = 900, **options: Any) -> Iterator[Opened]:
    """A page of a file in a window; `options` as of Playwright's contexts. `script` runs before those of the page."""
    script = options.pop("script", None)
    context = browser.new_context(viewport={"width": width, "height": height}, **options)
    try:
        context.set_default_timeout(10_000)
        page = Opened(context.new_page())
        if script is not None:
            page.page.add_init_script(script)
        page.page.goto(path.as_uri())
        if options.get("java_script_enabled", True):
            page.page.wait_for_function(READY, timeout=120_000)
        yield page
    finally:
        context.close()
