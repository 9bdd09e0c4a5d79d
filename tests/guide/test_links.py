"""Every link between pages, and every page that an error names, leads to a file that is there, and to its heading."""

from __future__ import annotations

import inspect
from pathlib import Path

import pytest
from given_commands import command
from places import REPOSITORY, script

from gtsam_rwhec import errors

guide = script(REPOSITORY / "docs" / "building" / "links.py")
PAGES = sorted(
    path
    for folder in (REPOSITORY, REPOSITORY / "docs", REPOSITORY / "factors", REPOSITORY / "examples")
    for path in folder.glob("*.md")
)


def lost(page: Path) -> list[str]:
    """Links of a page that lead to nothing."""
    found = []
    for link in guide.links(page.read_text(encoding="utf-8")):
        target, anchor = guide.target_of(link, page)
        there = target.exists()
        if there and anchor and target.suffix == ".md":
            there = anchor in guide.anchors(target.read_text(encoding="utf-8"))
        if not there:
            found.append(link)
    return found


@pytest.mark.parametrize("page", PAGES, ids=lambda path: str(path.relative_to(REPOSITORY)))
def test_links_lead_somewhere(page: Path) -> None:
    assert lost(page) == []


def test_links_that_lead_nowhere_are_found(tmp_path: Path) -> None:
    (tmp_path / "other.md").write_text("# One title\n\n```\n# no title\n```\n", encoding="utf-8")
    page = tmp_path / "page.md"
    good = "[a](other.md#one-title) [b](#words-and-code) [`c`](../) [d](https://no.where)\n## Words, and `code`\n"
    page.write_text(f"{good}`[e](in_code.md)`\n[f](none.md) ![g](other.md#no-title) [h](#nothing)\n", encoding="utf-8")
    assert lost(page) == ["none.md", "other.md#no-title", "#nothing"]


def test_links_are_led_to_the_guides_pages() -> None:
    page = REPOSITORY / "docs" / "refinement.md"
    text = "[a](../factors/README.md#priors) [b](../data) [c](../data/make_demo.py) [d](files.md) `[e](../README.md)`"
    led = guide.with_links_of_the_guide(text, page, page.parent)
    assert led == "[a](made/factors.md#priors) b [c](../data/make_demo.py) [d](files.md) `[e](../README.md)`"
    contributing = REPOSITORY / "CONTRIBUTING.md"
    led = guide.with_links_of_the_guide("[a](docs/files.md) [b](README.md)", contributing, REPOSITORY / "docs" / "made")
    assert led == "[a](../files.md) [b](../index.md)"


CLASSES = [kind for _name, kind in inspect.getmembers(errors, inspect.isclass) if issubclass(kind, errors.RwhecError)]


@pytest.mark.parametrize("kind", CLASSES, ids=lambda kind: kind.__name__)
def test_the_page_is_there(kind: type[errors.RwhecError]) -> None:
    path, _, anchor = kind.page.partition("#")
    if path:
        text = (REPOSITORY / path).read_text(encoding="utf-8")
        assert not anchor or anchor in guide.anchors(text)


def test_errors_of_files_have_a_page() -> None:
    assert all(kind.page for kind in CLASSES if issubclass(kind, errors.FileFormatError))


def test_the_command_names_it(tmp_path: Path) -> None:
    (tmp_path / "rig.yaml").write_text("sensorz: {}\n", encoding="utf-8")
    status, said = command("calibrate", "run.mcap", "--rig", tmp_path / "rig.yaml", "-o", tmp_path / "out")
    assert status == 2
    assert said.startswith("Error: ")
    assert said.endswith("More: docs/rig_file.md")
