"""Links between the repository's pages: where they lead, there and in the guide."""

from __future__ import annotations

import os
import re
from pathlib import Path

DOCS = Path(__file__).resolve().parent.parent
REPOSITORY = DOCS.parent

#: Pages of the repository that are not in ``docs/``, and where the guide has them, relative to ``docs/``.
ELSEWHERE = {
    "factors/README.md": "made/factors.md",
    "CONTRIBUTING.md": "made/contributing.md",
    "SECURITY.md": "made/security.md",
    "CHANGELOG.md": "made/changelog.md",
    "README.md": "index.md",
}
_LINK = re.compile(r"(!?)\[((?:[^\]\[]|\[[^\]]*\])*)\]\(([^()\s]+)\)")
_CODE = re.compile(r"^ *```.*?^ *```$|`[^`\n]+`", re.MULTILINE | re.DOTALL)
_HEADING = re.compile(r"^#+ +(.+?)\s*$", re.MULTILINE)


def anchors(text: str) -> set[str]:
    """The anchors of a page's headings, as repositories' web pages and MyST make them."""
    found: set[str] = set()
    for heading in _HEADING.findall(re.sub(r"^```.*?^```$", "", text, flags=re.MULTILINE | re.DOTALL)):
        name = re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-")
        number = 0
        while (name if not number else f"{name}-{number}") in found:
            number += 1
        found.add(name if not number else f"{name}-{number}")
    return found


def links(text: str) -> list[str]:
    """The addresses that a page's prose links to, without those of the network."""
    addresses = [found[3] for found in _LINK.finditer(_CODE.sub("code", text))]
    return [address for address in addresses if not re.match(r"[a-z]+:", address)]


def target_of(link: str, page: Path) -> tuple[Path, str]:
    """The file or folder that a link of a page leads to, and the anchor there (or "")."""
    path, _, anchor = link.partition("#")
    return ((page.parent / path).resolve() if path else page.resolve()), anchor


def _in_the_guide(link: str, page: Path, shown_in: Path) -> str | None:
    target, anchor = target_of(link, page)
    if target.is_dir():
        return None
    inside = str(target.relative_to(REPOSITORY)) if target.is_relative_to(REPOSITORY) else ""
    if inside in ELSEWHERE:
        target = DOCS / ELSEWHERE[inside]
    return os.path.relpath(target, shown_in) + (f"#{anchor}" if anchor else "")


def with_links_of_the_guide(text: str, page: Path, shown_in: Path) -> str:
    """A page's text with its links led to the guide's pages.

    Parameters
    ----------
    text
        Markdown.
    page
        The file that has it in the repository.
    shown_in
        The folder of the guide that has the page. A link to a folder of the repository stays as text.
    """
    kept: list[str] = []

    def mark(found: re.Match[str]) -> str:
        kept.append(found[0])
        return f"\0{len(kept) - 1}\0"

    def led(found: re.Match[str]) -> str:
        picture, words, address = found.groups()
        if re.match(r"[a-z]+:|#", address):
            return found[0]
        there = _in_the_guide(address, page, shown_in)
        return words if there is None else f"{picture}[{words}]({there})"

    changed = _LINK.sub(led, _CODE.sub(mark, text))
    return re.sub(r"\0(\d+)\0", lambda found: kept[int(found[1])], changed)
