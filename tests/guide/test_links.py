"""Every link between the repository's pages leads to a file that is there, and to a heading that the page has."""

from __future__ import annotations

from pathlib import Path

import pytest
from places import REPOSITORY, script

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
