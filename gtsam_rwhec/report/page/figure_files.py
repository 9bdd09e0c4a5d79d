"""The figures of a page as files: NAME.svg and NAME.png in a folder."""

from __future__ import annotations

from pathlib import Path

from gtsam_rwhec.errors import FileFormatError
from gtsam_rwhec.files.whole_files import write_atomically
from gtsam_rwhec.report.page.blocks import Chart, Drawing, Page, every
from gtsam_rwhec.report.page.figures import SvgFigure


def write_figures(page: Page, folder: str | Path) -> list[Path]:
    """Write every chart of a page, and the still pictures of its scenes, as SVG and PNG, black on white.

    Returns
    -------
    list of Path
        The files, in the order of the page.

    Raises
    ------
    FileFormatError
        The folder cannot be made, or a file cannot be written.
    """
    folder = Path(folder)
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise FileFormatError(f"{folder} cannot be made a folder: {error.strerror}.") from error
    written = []
    for name, figure in figures_of(page):
        for path, content in ((f"{name}.svg", figure.svg_file()), (f"{name}.png", figure.png_file())):
            write_atomically(folder / path, content)
            written.append(folder / path)
    return written


def figures_of(page: Page) -> list[tuple[str, SvgFigure]]:
    """The drawn figures of a page by name, those that are folded too."""
    found: list[tuple[str, str]] = []
    for block in every(block for section in page.sections for block in section.blocks):
        if isinstance(block, Chart):
            found.append((block.name, block.svg))
        elif isinstance(block, Drawing):
            found.append((block.name, block.still_svg))
    return [(name, svg) for name, svg in found if isinstance(svg, SvgFigure)]
