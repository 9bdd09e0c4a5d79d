"""The parts of pictures: names that cover nothing, round numbers, texts that fit."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from gtsam_rwhec.report.plots.coverage import _share
from gtsam_rwhec.report.plots.drawing import plain_decades, round_down, shortened
from gtsam_rwhec.report.plots.frames import CHI2_95, _shadow, write_names

AXES = Figure().subplots()


@settings(max_examples=8, deadline=None)
@given(st.integers(0, 10**6), st.integers(1, 9))
def test_names_cover_neither_each_other_nor_the_drawing(seed: int, count: int) -> None:
    generator = np.random.default_rng(seed)
    figure = Figure(figsize=(6.0, 5.0), dpi=100)
    FigureCanvasAgg(figure)
    axes = figure.subplots()
    points = generator.uniform(0.0, 1.0, (count, 2))
    points[-1] = points[0]  # two at one place
    clear_of = generator.uniform(0.0, 1.0, (12, 2))
    axes.plot(*clear_of.T[:, None], ".")  # one line for each point
    axes.set(xlim=(-0.1, 1.1), ylim=(-0.1, 1.1))
    figure.draw_without_rendering()
    write_names(axes, points, [f"frame_{i}" for i in range(count)])
    figure.draw_without_rendering()
    boxes = [text.get_window_extent() for text in axes.texts]
    assert [text.get_text() for text in axes.texts] == [f"frame_{i}" for i in range(count)]
    drawn = axes.transData.transform(np.vstack([points, clear_of]))
    for i, box in enumerate(boxes):
        inside = (drawn > (box.x0, box.y0)) & (drawn < (box.x1, box.y1))
        assert not inside.all(axis=1).any()
        for other in boxes[:i]:
            assert not box.overlaps(other)
        assert axes.bbox.x0 <= box.x0 < box.x1 <= axes.bbox.x1


@given(st.floats(1e-12, 1e12))
def test_round_numbers_are_below_and_near(number: float) -> None:
    rounded = round_down(number)
    assert number / 2.5 * (1.0 - 1e-9) <= rounded <= number * (1.0 + 1e-9)
    assert f"{rounded:.6e}"[0] in "125"
    assert float(f"{rounded:.0e}") == pytest.approx(rounded)


@given(st.text(max_size=200), st.integers(8, 60))
def test_texts_fit_on_a_line(text: str, most: int) -> None:
    short = shortened(text, most)
    assert len(short) <= most
    assert short.isprintable()


def test_short_texts_stay_and_long_ones_keep_both_ends() -> None:
    assert shortened("moving fast (m/s)") == "moving fast (m/s)"
    assert shortened("a" * 50 + "b" * 50, 11) == "aaaa...bbbb"


@settings(max_examples=25, deadline=None)
@given(st.floats(-9.0, 9.0), st.floats(1.3, 6.0))
def test_axes_have_numbers_within_them(low: float, decades: float) -> None:
    AXES.set_xscale("log")
    ends = 10.0**low, 10.0 ** (low + decades)
    plain_decades(AXES.xaxis, *ends)
    ticks = AXES.xaxis.get_majorticklocs()
    assert [float(label.get_text()) for label in AXES.get_xticklabels()] == pytest.approx(ticks.tolist())
    assert len(ticks) >= 1
    assert ((ticks >= ends[0]) & (ticks <= ends[1])).all()


def test_an_ellipsoid_holds_95_of_100_positions() -> None:
    """The ellipsoid's shadow along the third axis is the shadow of all points within it."""
    generator = np.random.default_rng(4)
    root = generator.standard_normal((3, 3))
    points = generator.standard_normal((200_000, 3)) @ root.T
    covariance = root @ root.T
    within = np.einsum("ni,ij,nj->n", points, np.linalg.inv(covariance), points) <= CHI2_95
    assert within.mean() == pytest.approx(0.95, abs=2e-3)
    outline = _shadow(covariance[:2, :2])
    for turn in np.linspace(0.0, np.pi, 7):
        towards = np.array([np.cos(turn), np.sin(turn)])
        reach = (points[within, :2] @ towards).max()
        assert reach == pytest.approx((outline @ towards).max(), rel=0.02)


def test_coverage_is_the_share_of_cells_with_corners() -> None:
    size = (640.0, 480.0)
    assert _share(np.array([[0.0, 0.0]]), size) == pytest.approx(1.0 / (16 * 12))
    u, v = np.meshgrid(np.arange(0.0, 640.0, 10.0), np.arange(0.0, 480.0, 10.0))
    assert _share(np.column_stack([u.ravel(), v.ravel()]), size) == 1.0
    assert _share(np.column_stack([u[:, :32].ravel(), v[:, :32].ravel()]), size) == 0.5
    # Just outside counts to the cell beside it.
    assert _share(np.array([[-0.6, 480.2], [700.0, -3.0]]), size) == pytest.approx(2.0 / (16 * 12))
