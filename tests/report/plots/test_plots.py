"""Pictures show their data, and equal data gives equal bytes."""

from __future__ import annotations

import io
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
import pytest
from made_up import corners, covariances, intrinsics, measurements, rig
from matplotlib.image import imread

from gtsam_rwhec.errors import CountError, FileFormatError, NoiseError
from gtsam_rwhec.report.plots import (
    PlottedCorners,
    PlottedMeasurement,
    plot_coverage,
    plot_deviations,
    plot_frames,
    plot_intrinsics,
    plot_residuals,
)
from gtsam_rwhec.report.plots.frames import _Scene
from gtsam_rwhec.rig import RigFrames

FRAMES = rig(2)
COVARIANCES = covariances(FRAMES)
MEASUREMENTS = measurements(FRAMES, 20)
CORNERS = corners(FRAMES, 200)
INTRINSICS = intrinsics(rig(1), corners(rig(1), 200))
EMPTY = RigFrames("hand", "base", {}, {})

DRAWN: dict[str, Callable[[Path], None]] = {
    "frames": lambda path: plot_frames(FRAMES, COVARIANCES, path),
    "residuals": lambda path: plot_residuals(MEASUREMENTS, path),
    "coverage": lambda path: plot_coverage(CORNERS, FRAMES.cameras, path),
    "deviations": lambda path: plot_deviations(FRAMES, COVARIANCES, path),
    "intrinsics": lambda path: plot_intrinsics(INTRINSICS, path),
}


def drawn(folder: Path, draw: Callable[..., None], *arguments: Any) -> np.ndarray:
    """Draw a picture, and return its pixels (rows, columns, 4), 0 to 1."""
    path = folder / "picture.png"
    draw(*arguments, path)
    pixels = np.asarray(imread(io.BytesIO(path.read_bytes())))
    path.unlink()
    assert not list(folder.iterdir())
    return pixels


def ink(pixels: np.ndarray) -> float:
    """Share of the pixels that are not white."""
    return float((pixels[..., :3].min(axis=2) < 0.95).mean())


def has_colour(pixels: np.ndarray, colour: str) -> bool:
    wanted = np.array([int(colour[i : i + 2], 16) / 255.0 for i in (1, 3, 5)])
    return bool((np.abs(pixels[..., :3] - wanted).max(axis=2) < 0.02).any())


@pytest.mark.parametrize("name", DRAWN)
def test_equal_input_gives_equal_bytes(name: str, tmp_path: Path) -> None:
    before = dict(matplotlib.rcParams)
    paths = [tmp_path / "first.png", tmp_path / "second.png"]
    DRAWN[name](paths[0])
    with matplotlib.rc_context({"axes.facecolor": "red", "font.size": 30.0, "lines.linewidth": 9.0}):
        DRAWN[name](paths[1])  # whatever the user's own style is
    assert paths[0].read_bytes() == paths[1].read_bytes()
    assert dict(matplotlib.rcParams) == before
    pixels = np.asarray(imread(str(paths[0])))
    assert 0.01 < ink(pixels) < 0.8
    assert min(pixels.shape[:2]) > 300


@pytest.fixture(scope="module")
def finite(tmp_path_factory: pytest.TempPathFactory) -> dict[Any, np.ndarray]:
    """Pictures of frames that are all determined."""
    folder = tmp_path_factory.mktemp("finite")
    return {draw: drawn(folder, draw, FRAMES, COVARIANCES) for draw in (plot_frames, plot_deviations)}


def test_ellipsoids_are_drawn(finite: dict[Any, np.ndarray], tmp_path: Path) -> None:
    assert ink(finite[plot_frames]) > ink(drawn(tmp_path, plot_frames, FRAMES, {})) + 1e-4


@pytest.mark.parametrize("place", [(3, 3), (0, 0)])
def test_infinite_covariances_are_marked(place: tuple[int, int], finite: dict[Any, np.ndarray], tmp_path: Path) -> None:
    """A circle marks a position that is not determined; the deviations have a strip for infinite values."""
    free = {name: covariance.copy() for name, covariance in COVARIANCES.items()}
    free["tag_1"][place] = np.inf
    purple = "#CC79A7"
    assert has_colour(drawn(tmp_path, plot_frames, FRAMES, free), purple) is (place == (3, 3))
    assert not has_colour(finite[plot_frames], purple)
    # The strip for what is not determined.
    assert ink(drawn(tmp_path, plot_deviations, FRAMES, free)) > ink(finite[plot_deviations]) + 0.01


def test_covariances_all_infinite_zero_or_missing(tmp_path: Path) -> None:
    two = RigFrames("hand", "base", {"cam": np.eye(4)}, {"tag": np.eye(4)})
    for variance in (np.inf, 0.0):
        given = {name: np.diag(np.full(6, variance)) for name in ("cam", "tag")}
        assert ink(drawn(tmp_path, plot_frames, two, given)) > 0.005
        assert ink(drawn(tmp_path, plot_deviations, two, given)) > 0.005
    assert ink(drawn(tmp_path, plot_deviations, two, {})) > 0.005


def test_an_empty_picture_says_so(tmp_path: Path) -> None:
    for draw, arguments in (
        (plot_frames, (EMPTY, {})),
        (plot_deviations, (EMPTY, {})),
        (plot_residuals, ({},)),
        (plot_coverage, ({}, {})),
        (plot_intrinsics, ({},)),
    ):
        assert 0.0 < ink(drawn(tmp_path, draw, *arguments)) < 0.05


def test_one_frame_at_the_carriers_origin(tmp_path: Path) -> None:
    alone = RigFrames("hand", "base", {"cam": np.eye(4)}, {})
    assert ink(drawn(tmp_path, plot_frames, alone, {"cam": 1e-6 * np.eye(6)})) > 0.01


def test_a_far_origin_does_not_shrink_the_frames(tmp_path: Path) -> None:
    """Targets a kilometre from the world's origin stay a metre apart in the picture, and a note says why."""
    targets = {"a": np.eye(4), "b": np.eye(4)}
    for name, x in (("a", 1000.0), ("b", 1001.0)):
        targets[name][0, 3] = x
    scene = _Scene("base", targets, {})
    assert (scene.extent, scene.has_origin) == (1.0, False)
    assert "origin of base is out of sight" in scene.note
    assert ink(drawn(tmp_path, plot_frames, RigFrames("hand", "base", {}, targets), {})) > 0.01


def test_reasons_have_symbols_of_their_own(tmp_path: Path) -> None:
    def one(reason: str) -> dict[tuple[str, str], PlottedMeasurement]:
        used = np.arange(20) < 12
        words = ["" if u else reason if i % 2 else "first" for i, u in enumerate(used)]
        values = np.linspace(0.1, 1.0, 20)
        return {("tag", "cam"): PlottedMeasurement(np.arange(20.0), values, values, used, words)}

    green = "#E69F00"
    assert has_colour(drawn(tmp_path, plot_residuals, one("second")), green)
    assert not has_colour(drawn(tmp_path, plot_residuals, one("first")), green)


def test_many_and_strange_reasons(tmp_path: Path) -> None:
    """Reasons come from logs, which other people write."""
    words = [
        "$\\frac{1}{$",
        "a\nb",
        "",
        "日本",
        "\x00\x07",
        "x" * 5000,
        "%s {0}",
        "\\alpha$",
        *(f"reason {i}" for i in range(20)),
    ]
    N = len(words)
    values = np.r_[np.nan, np.inf, 0.0, -1.0, np.full(N - 4, 0.5)]
    measured = PlottedMeasurement(np.arange(float(N)), values, values[::-1].copy(), np.zeros(N, dtype=bool), words)
    assert ink(drawn(tmp_path, plot_residuals, {("tag", "cam"): measured})) > 0.01


def test_residuals_that_are_all_zero_or_unknown(tmp_path: Path) -> None:
    for value in (0.0, np.nan):
        values = np.full(5, value)
        measured = PlottedMeasurement(np.arange(5.0), values, values, np.ones(5, dtype=bool), [""] * 5)
        assert ink(drawn(tmp_path, plot_residuals, {("tag", "cam"): measured})) > 0.001
    none = PlottedMeasurement(np.zeros(0), np.zeros(0), np.zeros(0), np.zeros(0, dtype=bool), [])
    assert ink(drawn(tmp_path, plot_residuals, {("tag", "cam"): none})) > 0.001


def test_a_sensor_without_corners_or_intrinsics(tmp_path: Path) -> None:
    none = PlottedCorners(np.zeros((0, 2)), np.zeros((0, 2)))
    exact = PlottedCorners(np.full((9, 2), 50.0), np.zeros((9, 2)))
    odd = PlottedCorners(np.array([[10.0, 20.0], [np.nan, 3.0]]), np.array([[0.1, 0.2], [0.1, np.inf]]))
    assert ink(drawn(tmp_path, plot_coverage, {"a": none, "b": exact, "c": odd}, {})) > 0.001
    assert ink(drawn(tmp_path, plot_coverage, {"a": none}, {})) > 0.001


def test_mean_errors_that_are_alike_in_the_images_have_a_colour_of_their_own(tmp_path: Path) -> None:
    """There the lens model lacks something; errors that the corners of an image share, as those of A, are by chance."""
    rng, (name, of) = np.random.default_rng(3), next(iter(INTRINSICS.items()))
    pixels, image = rng.uniform(0.0, 900.0, size=(2000, 2)), np.arange(2000) % 20
    by_image = rng.normal(scale=0.5, size=(20, 2))[image] + rng.normal(scale=0.1, size=pixels.shape)
    blue = "#0072B2"

    def panel(errors: np.ndarray) -> np.ndarray:
        given = replace(of, corners=PlottedCorners(pixels, errors), image=image)
        return drawn(tmp_path, plot_intrinsics, {name: given})[60:-60]

    assert not has_colour(panel(by_image), blue)
    assert has_colour(panel(by_image + np.where(pixels > 600.0, 1.0, 0.0)), blue)


def test_cameras_with_little_to_say(tmp_path: Path) -> None:
    none = PlottedCorners(np.zeros((0, 2)), np.zeros((0, 2)))
    of = next(iter(INTRINSICS.values()))
    nothing = np.zeros(0, dtype=int)
    unknown = replace(
        of, corners=none, image=nothing, deviations_px=np.full(of.deviations_px.shape, np.nan), held_out_px=()
    )
    alike = replace(of, deviations_px=np.ones(of.deviations_px.shape), held_out_px=((0.0, None),))
    assert ink(drawn(tmp_path, plot_intrinsics, {"a": unknown, "b": alike})) > 0.01


def test_eight_sensors(tmp_path: Path) -> None:
    frames = rig(8)
    assert ink(drawn(tmp_path, plot_coverage, corners(frames, 100), frames.cameras)) > 0.01


def test_long_names_leave_room(tmp_path: Path) -> None:
    name = "rig/" + "a" * 90
    frames = RigFrames("hand", "base", {name: np.eye(4)}, {})
    for draw in (plot_frames, plot_deviations):
        assert ink(drawn(tmp_path, draw, frames, {name: 1e-6 * np.eye(6)})) > 0.01


def test_wrong_input_is_refused(tmp_path: Path) -> None:
    with pytest.raises(CountError, match="one length"):
        PlottedMeasurement(np.zeros(3), np.zeros(3), np.zeros(2), np.ones(3, dtype=bool), [""] * 3)
    with pytest.raises(CountError, match=r"\(N, 2\)"):
        PlottedCorners(np.zeros((3, 2)), np.zeros((2, 2)))
    for draw in (plot_frames, plot_deviations):
        with pytest.raises(NoiseError, match="not negative"):
            draw(FRAMES, {"tag_0": -np.eye(6)}, tmp_path / "picture.png")
    with pytest.raises(FileFormatError, match="cannot be written: No such file"):
        plot_frames(FRAMES, {}, tmp_path / "nowhere" / "picture.png")
    assert not list(tmp_path.iterdir())


def test_matplotlib_is_imported_when_something_is_drawn_and_pyplot_never() -> None:
    program = """
import sys
import gtsam_rwhec.report.plots as plots
assert not any(name.startswith("matplotlib") for name in sys.modules)
plots.plot_residuals({}, sys.argv[1])
assert "matplotlib" in sys.modules and "matplotlib.pyplot" not in sys.modules
"""
    subprocess.run([sys.executable, "-c", program, "/dev/null"], check=True)
