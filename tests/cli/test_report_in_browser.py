"""Reports looked at in headless Chromium: wide and narrow, light and dark, on paper, without JavaScript and WebGL."""

from __future__ import annotations

import io
import re
import unicodedata
from collections.abc import Iterator
from importlib.resources import files
from pathlib import Path
from typing import Any

import pytest
from browser import ARGUMENTS, chromium, opened, screenshots
from given_commands import command
from PIL import Image

pytestmark = pytest.mark.browser

WIDTHS = (1280, 390)
SCHEMES = ("light", "dark")
REPORTS = ("demo", "real")
#: What must be on paper.
PRINTED = "h2, main summary, .caption, th, td, main li, figcaption, main p:not(.how):not(.title):not(.buttons)"
NO_CLIPBOARD = "Object.defineProperty(Navigator.prototype, 'clipboard', { get: () => undefined })"
NO_WEBGL = "HTMLCanvasElement.prototype.getContext = () => null"
NO_DECOMPRESSION = "delete window.DecompressionStream"


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        started = playwright.chromium.launch(executable_path=chromium(), args=ARGUMENTS)
        yield started
        started.close()


@pytest.fixture(scope="module")
def looks(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return screenshots(tmp_path_factory)


@pytest.fixture(scope="module")
def reports(tmp_path_factory: pytest.TempPathFactory, utias_folder: Path) -> dict[str, Path]:
    """The reports of the shipped demo and of the real dataset, as the command writes them when one is asked for."""
    return _Reports(tmp_path_factory.mktemp("reports"), utias_folder)


class _Reports(dict[str, Path]):
    def __init__(self, folder: Path, real: Path) -> None:
        super().__init__()
        self.folder, self.real = folder, real

    def __missing__(self, name: str) -> Path:
        if name == "demo":
            assert command("demo", "-o", self.folder / "demo")[0] == 0
            self[name] = self.folder / "demo" / "report.html"
        else:
            command("calibrate", self.real, "-o", self.folder / "real.json")
            self[name] = self.folder / "real.html"
        return self[name]


@pytest.mark.parametrize("scheme", SCHEMES)
@pytest.mark.parametrize("width", WIDTHS)
@pytest.mark.parametrize("name", REPORTS)
def test_nothing_is_cut_and_nothing_overlaps(
    browser: Any, reports: dict[str, Path], looks: Path, name: str, width: int, scheme: str
) -> None:
    with opened(browser, reports[name], width=width, color_scheme=scheme) as report:
        report.photograph(looks, f"{name}-{width}-{scheme}")
        assert report.wrong_layout() == []
        report.page.evaluate("for (const folded of document.querySelectorAll('main details')) folded.open = true")
        assert report.wrong_layout() == []
        assert report.complaints == []


@pytest.mark.parametrize("scheme", SCHEMES)
@pytest.mark.parametrize("width", WIDTHS)
@pytest.mark.parametrize("name", REPORTS)
def test_people_with_other_abilities_can_use_it(
    browser: Any, reports: dict[str, Path], name: str, width: int, scheme: str
) -> None:
    with opened(browser, reports[name], width=width, color_scheme=scheme) as report:
        report.page.evaluate("for (const folded of document.querySelectorAll('details')) folded.open = true")
        report.page.evaluate(files("axe_playwright_python").joinpath("axe.min.js").read_text(encoding="utf-8"))
        found = report.page.evaluate("axe.run({ resultTypes: ['violations'] })")
    serious = [
        (one["id"], one["help"], [node["target"] for node in one["nodes"]][:3])
        for one in found["violations"]
        if one["impact"] in ("serious", "critical")
    ]
    assert serious == []
    assert len(found["passes"]) > 20


def camera(page: Any) -> dict[str, float]:
    return page.evaluate(
        "(({ x, y, z }) => ({ x, y, z }))(document.querySelector('.turn')._fullLayout.scene._scene.getCamera().eye)"
    )


@pytest.mark.parametrize("width", WIDTHS)
@pytest.mark.parametrize("name", REPORTS)
def test_the_rig_turns_and_takes_the_colours_of_the_page(
    browser: Any, reports: dict[str, Path], name: str, width: int
) -> None:
    with opened(browser, reports[name], width=width, color_scheme="light") as report:
        page = report.page
        scene = page.locator(".turn").first
        scene.scroll_into_view_if_needed()
        before = camera(page)
        box = scene.bounding_box()
        x, y = box["x"] + 0.5 * box["width"], box["y"] + 0.5 * box["height"]
        page.mouse.move(x, y)
        page.mouse.down()
        page.mouse.move(x + 60.0, y + 25.0, steps=5)
        page.mouse.up()
        page.wait_for_timeout(300)
        turned = camera(page)
        assert max(abs(turned[axis] - before[axis]) for axis in "xyz") > 0.05
        ink = page.evaluate("document.querySelector('.turn')._fullLayout.font.color")
        page.emulate_media(color_scheme="dark")
        page.wait_for_function(f"() => document.querySelector('.turn')._fullLayout.font.color !== '{ink}'")
        kept = camera(page)
        assert max(abs(turned[axis] - kept[axis]) for axis in "xyz") < 1e-6
        assert report.complaints == []


@pytest.mark.parametrize("script", [None, NO_CLIPBOARD], ids=["clipboard", "selection"])
def test_copy_buttons_copy(browser: Any, reports: dict[str, Path], script: str | None) -> None:
    with opened(browser, reports["demo"], script=script, permissions=["clipboard-read", "clipboard-write"]) as report:
        page = report.page
        reader = page.context.new_page()
        reader.goto(reports["demo"].as_uri())
        for button in page.locator("[data-copy]").all():
            page.bring_to_front()
            button.evaluate("(button) => { button.closest('details').open = true }")
            button.click()
            page.wait_for_function("(button) => button.nextElementSibling.textContent", arg=button.element_handle())
            assert button.evaluate("(button) => button.nextElementSibling.textContent") == "Copied."
            text = button.evaluate("(button) => document.getElementById(button.dataset.copy).textContent")
            if script is None:
                assert page.evaluate("navigator.clipboard.readText()") == text
            else:
                assert page.evaluate("getSelection().toString()").split() == text.split()


def test_figures_are_saved(browser: Any, reports: dict[str, Path], tmp_path: Path) -> None:
    with opened(browser, reports["demo"]) as report:
        page = report.page
        figures = {"chart": "figure:not(.drawing)", "scene": "figure.drawing"}
        for kind, selector in figures.items():
            for form in ("svg", "png"):
                button = page.locator(f"{selector} [data-save={form}]").first
                with page.expect_download() as download:
                    button.click()
                download.value.save_as(tmp_path / f"{kind}.{form}")
                assert download.value.suggested_filename.endswith(f".{form}")
            assert "<svg" in (tmp_path / f"{kind}.svg").read_text(encoding="utf-8")
            with Image.open(tmp_path / f"{kind}.png") as image:
                assert min(image.size) > 300
                assert len(set(image.convert("L").getdata())) > 10
        assert "currentColor" not in (tmp_path / "chart.svg").read_text(encoding="utf-8")
        assert report.complaints == []


@pytest.mark.parametrize("scheme", SCHEMES)
@pytest.mark.parametrize("name", REPORTS)
def test_paper_has_everything(browser: Any, reports: dict[str, Path], looks: Path, name: str, scheme: str) -> None:
    from pypdf import PdfReader

    with opened(browser, reports[name], color_scheme=scheme) as report:
        content = report.page.pdf(prefer_css_page_size=True, print_background=True)
        shown = report.page.evaluate(
            f"[...document.querySelectorAll('{PRINTED}')].map((element) => element.textContent)"
        )
        # As wide as the paper between its margins, in pixels.
        report.page.set_viewport_size({"width": 688, "height": 1000})
        report.page.emulate_media(media="print")
        report.page.evaluate("for (const folded of document.querySelectorAll('main details')) folded.open = true")
        assert report.wrong_layout() == []
    (looks / f"{name}-{scheme}.pdf").write_bytes(content)
    pages = PdfReader(io.BytesIO(content)).pages
    assert {(round(float(page.mediabox.width)), round(float(page.mediabox.height))) for page in pages} <= {
        (595, 842),
        (596, 842),
    }
    packed = _packed("".join(page.extract_text() for page in pages))
    assert [text for text in shown if _packed(text) not in packed] == []


def _packed(text: str) -> str:
    """A text without white space, hyphens and ligatures, which are others on paper."""
    return re.sub(r"[\s\u00ad\u2010-]+", "", unicodedata.normalize("NFKC", text))


def test_without_javascript_everything_is_there_but_turning(browser: Any, reports: dict[str, Path]) -> None:
    with opened(browser, reports["demo"], java_script_enabled=False) as report:
        page = report.page
        assert page.locator(".drawing .still").first.is_visible()
        assert not page.locator(".drawing .turn").first.is_visible()
        assert "still picture" in page.locator(".drawing .how").first.inner_text()
        assert [button for button in page.locator("button").all() if button.is_visible()] == []
        assert page.locator("section").count() == page.locator("nav.side li").count()


@pytest.mark.parametrize(
    ("script", "why"), [(NO_WEBGL, "WebGL"), (NO_DECOMPRESSION, "older")], ids=["webgl", "decompression"]
)
def test_browsers_that_cannot_turn_the_rig_say_why(
    browser: Any, reports: dict[str, Path], script: str, why: str
) -> None:
    with opened(browser, reports["demo"], script=script) as report:
        figure = report.page.locator(".drawing").first
        assert figure.locator(".still").is_visible()
        assert why in figure.locator(".how").inner_text()
        assert report.complaints == []


def test_the_contents_stay_in_reach(browser: Any, reports: dict[str, Path]) -> None:
    for width, place in ((1280, "nav.side"), (390, ".fold summary")):
        with opened(browser, reports["demo"], width=width) as report:
            report.page.evaluate("scrollTo(0, document.body.scrollHeight)")
            report.page.wait_for_timeout(200)
            box = report.page.locator(place).bounding_box()
            assert box["y"] >= 0.0
            assert box["y"] + min(box["height"], 50.0) < 900.0
            assert report.page.locator("nav.side").is_visible() == (width == 1280)
