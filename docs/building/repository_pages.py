"""Pages of the repository that are not in ``docs/`` (how to contribute, the factors, ...) as pages of the guide.

They are written into ``docs/made/`` before each build. Links between pages are those of the repository, so that they
work there too; on the way into the guide they are led to its own pages. A link to another file becomes a download.
"""

from __future__ import annotations

from pathlib import Path

from sphinx.application import Sphinx

from building.links import DOCS, ELSEWHERE, REPOSITORY, with_links_of_the_guide


def write_if_other(path: Path, text: str) -> None:
    """Write a page that is made; one that is the same stays, so that Sphinx does not read it again."""
    path.parent.mkdir(parents=True, exist_ok=True)
    if not path.exists() or path.read_text(encoding="utf-8") != text:
        path.write_text(text, encoding="utf-8")


def _write_pages(*_: object) -> None:
    for source, place in ELSEWHERE.items():
        made = DOCS / place
        if made.parent != DOCS:
            text = (REPOSITORY / source).read_text(encoding="utf-8")
            write_if_other(made, with_links_of_the_guide(text, REPOSITORY / source, made.parent))


def _lead_links(app: Sphinx, docname: str, source: list[str]) -> None:
    page = Path(app.env.doc2path(docname)).resolve()
    if page.suffix == ".md" and not page.is_relative_to(DOCS / "made"):
        source[0] = with_links_of_the_guide(source[0], page, page.parent)


def setup(app: Sphinx) -> dict[str, bool]:
    """Connect to Sphinx."""
    app.connect("config-inited", _write_pages)
    app.connect("source-read", _lead_links)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
