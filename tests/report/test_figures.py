"""Figures of a page: of the page's colour in it, black on white as files, and each with ids of its own."""

from __future__ import annotations

import io
import re
import warnings
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
from matplotlib.figure import Figure
from matplotlib.ticker import MultipleLocator
from PIL import Image

import gtsam_rwhec as rw
from gtsam_rwhec.report.figures import FILE_DPI, svg_figure
from gtsam_rwhec.report.html_page import page_html
from gtsam_rwhec.report.report_blocks import Chart, Drawing, Folded, Page, Section
from gtsam_rwhec.report.report_page import write_figures


def points(figure: Figure) -> None:
    axes = figure.subplots()
    axes.plot([0.0, 1.0, 2.0], [1.0, 0.0, 1.0], "o-", label="cam_0")
    axes.set(xlabel="time, s", ylabel="residual, mm")
    axes.legend()


def page() -> Page:
    svg = svg_figure(points, 2.0, 3.0)
    folded = Folded("More", (Chart("second", "Second", "It shows the same.", svg),))
    drawing = Drawing("rig", "Rig", "It shows a rig.", (), {}, svg)
    chart = Chart("first", "First", "It shows points.", svg)
    return Page("A page", "good", (Section("a", "A", (chart, folded, drawing)),), "by hand")


def test_figures_take_the_colour_of_the_page_and_equal_ones_are_equal() -> None:
    svg = svg_figure(points).in_page
    assert svg == svg_figure(points).in_page
    assert "currentColor" in svg
    assert "#010203" not in svg


def test_ids_of_figures_are_their_own_and_lead_somewhere() -> None:
    text = page_html(page())
    ids = re.findall(r' id="([^"]+)"', text)
    assert len(ids) == len(set(ids))
    used = re.findall(r'(?:xlink:href="#|url\(#)([^")]+)', text)
    assert len(used) > 6
    assert set(used) <= set(ids)


@pytest.mark.parametrize("numbers", [(0.0, 1e300), (1e-320, 1.0), (np.nan, np.inf), (5.0, 5.0), (-1e18, 1e18)])
@pytest.mark.parametrize("scale", ["linear", "log"])
def test_no_numbers_end_a_run(numbers: tuple[float, float], scale: str) -> None:
    """Logarithms of what has none, and transforms that overflow."""

    def draw(figure: Figure) -> None:
        axes = figure.subplots()
        axes.plot(numbers, numbers, "o")
        axes.set(xscale=scale, yscale=scale)

    with warnings.catch_warnings(action="ignore"):
        for content in (svg_figure(draw).in_page.encode(), svg_figure(draw).file("png")):
            assert b"<svg" in content or content.startswith(b"\x89PNG")


def test_a_figure_that_cannot_be_drawn_says_why() -> None:
    def draw(figure: Figure) -> None:
        raise RuntimeError("Locator attempting to generate 1601 ticks")

    assert "1601 ticks" in svg_figure(draw).in_page


def test_every_figure_is_written_as_svg_and_png(tmp_path: Path) -> None:
    written = write_figures(page(), tmp_path / "new" / "figures")
    assert [path.name for path in written] == [
        f"{name}.{kind}" for name in ("first", "second", "rig") for kind in ("svg", "png")
    ]
    svg, png = (path.read_bytes() for path in written[:2])
    assert ElementTree.fromstring(svg).attrib["width"] == "216pt"
    assert b"currentColor" not in svg
    with Image.open(io.BytesIO(png)) as image:
        assert image.size == (3 * FILE_DPI, 2 * FILE_DPI)
        pixels = np.asarray(image.convert("RGB"))
    assert tuple(pixels[0, 0]) == (255, 255, 255)
    assert pixels.min() < 30


def test_a_folder_that_cannot_be_made_is_said(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(rw.errors.FileFormatError, match="cannot be made a folder"):
        write_figures(page(), tmp_path / "file")


@pytest.mark.parametrize("is_along_x", [True, False])
def test_ticks_do_not_come_from_the_extent(is_along_x: bool, caplog: pytest.LogCaptureFixture) -> None:
    """One value of 1e-200 made 1601 ticks, laid out again and again, with a warning each time."""
    figures: list[Figure] = []

    def draw(figure: Figure) -> None:
        axes = figure.subplots()
        small, one = (1e-200, 1.0), (0.0, 1.0)
        axes.plot(*((small, one) if is_along_x else (one, small)), "o")
        axes.set(xscale="log" if is_along_x else "linear", yscale="linear" if is_along_x else "log")
        figures.append(figure)

    with warnings.catch_warnings(action="error"):
        assert "cannot be drawn" not in svg_figure(draw).in_page
    (axes,) = figures[0].axes
    axis = axes.xaxis if is_along_x else axes.yaxis
    assert len(axis.get_majorticklocs()) + len(axis.get_minorticklocs()) < 300
    assert not caplog.records


def test_an_axis_with_a_tick_a_unit_has_few_where_its_values_are_large() -> None:
    figures: list[Figure] = []

    def draw(figure: Figure) -> None:
        axes = figure.subplots()
        axes.plot([0.0, 900.0], [0.0, 1.0])
        axes.xaxis.set_major_locator(MultipleLocator(1.0))
        figures.append(figure)

    assert svg_figure(draw).in_page
    assert len(figures[0].axes[0].get_xticks()) < 20


def test_what_matplotlib_warns_of_reaches_nobody() -> None:
    def draw(figure: Figure) -> None:
        warnings.warn("constrained_layout not applied", UserWarning, stacklevel=2)
        points(figure)

    with warnings.catch_warnings(record=True, action="always") as heard:
        assert "cannot be drawn" not in svg_figure(draw).in_page
    assert not heard
