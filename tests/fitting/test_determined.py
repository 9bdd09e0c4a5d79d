"""Corners that determine no poses, or belong to others, are refused in words."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from simulated_cells import Cell, cell

import gtsam_rwhec as rw
from gtsam_rwhec.errors import CameraError, FrameError, OptionError, OutlierError, UnderdeterminedError
from gtsam_rwhec.fitting.corner_checks import told_where_it_fails
from gtsam_rwhec.fitting.observations import Views

OPTIONS = [rw.CornerOptions(), rw.CornerOptions(carrier_noise="exact")]
IDS = ["estimated", "exact"]


@pytest.fixture(scope="module")
def given() -> Cell:
    return cell(1, images=16)


def refined(given: Cell, change: Callable[[Views], Views], options: rw.CornerOptions) -> rw.CornersRefined:
    """Refined from a start near the truth, with every view changed."""
    X, Y = given.near(np.random.default_rng(9))
    views = {pair: change(view) for pair, view in given.observations.views.items()}
    return rw.refine_corners(replace(given.observations, views=views), X, Y, options)


@pytest.mark.parametrize("options", OPTIONS, ids=IDS)
def test_random_pixels_belong_to_no_poses(given: Cell, options: rw.CornerOptions) -> None:
    rng = np.random.default_rng(0)
    with pytest.raises(OutlierError, match=r"corners of board in the images of cam_0 do not belong .* off by \d+ pix"):
        refined(given, lambda view: Views(view.A, rng.uniform(0.0, 1080.0, view.pixels.shape)), options)


@pytest.mark.parametrize("options", OPTIONS, ids=IDS)
def test_one_image_a_camera_determines_no_pose(given: Cell, options: rw.CornerOptions) -> None:
    with pytest.raises(UnderdeterminedError, match=r"pose of .*cam_0 .*2 images at 2 .* turn about two axes"):
        refined(given, lambda view: Views(view.A[:1], view.pixels[:1]), options)


@pytest.mark.parametrize("options", OPTIONS, ids=IDS)
def test_a_carrier_that_stands_still_determines_no_pose(options: rw.CornerOptions) -> None:
    still = cell(1, cameras=1, images=1)
    with pytest.raises(UnderdeterminedError, match=r"pose of board .*, cam_0 .*5 images at one pose"):
        refined(still, lambda view: Views(np.repeat(view.A, 5, 0), np.repeat(view.pixels, 5, 0)), options)


@pytest.mark.parametrize("options", OPTIONS, ids=IDS)
def test_one_pose_for_all_images_contradicts_them(given: Cell, options: rw.CornerOptions) -> None:
    with pytest.raises(OutlierError, match=r"at 2 different poses of the carriers.* the pose A of its own instant"):
        refined(given, lambda view: Views(np.repeat(view.A[:1], len(view.A), 0), view.pixels), options)


@pytest.mark.parametrize("options", OPTIONS, ids=IDS)
def test_corners_on_one_pixel_determine_no_pose(given: Cell, options: rw.CornerOptions) -> None:
    with pytest.raises(UnderdeterminedError, match=r"do not determine the pose of .*cam_1 "):
        refined(given, lambda view: Views(view.A, np.full(view.pixels.shape, 500.0)), options)


def test_turns_about_one_axis_leave_the_place_along_it_free(given: Cell) -> None:
    turns = np.tile(np.eye(4), (12, 1, 1))
    for T, angle in zip(turns, np.linspace(-0.3, 0.3, 12), strict=True):
        T[:2, :2] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
    A = turns @ given.observations.views["board", "cam_0"].A[0]
    camera = given.cameras["cam_0"]
    T = np.linalg.inv(given.Y["cam_0"]) @ A @ given.X["board"]
    points = given.observations.corners["board"]
    seen = np.einsum("vij,nj->vni", T[:, :3, :3], points) + T[:, None, :3, 3]
    pixels = camera.with_parameters(camera.parameters).pixels(seen[..., :2] / seen[..., 2:])
    pixels = pixels + np.random.default_rng(0).normal(scale=0.1, size=pixels.shape)
    observations = rw.Observations.of(
        {"cam_0": given.observations.cameras["cam_0"]}, {"board": points}, {("board", "cam_0"): (A, pixels)}
    )
    with pytest.raises(UnderdeterminedError, match=r"pose of .*two axes"):
        rw.refine_corners(observations, given.X, given.Y, OPTIONS[1])


def test_a_start_without_a_frame_is_named(given: Cell) -> None:
    with pytest.raises(
        FrameError, match=r"start X lacks the target board \(it is empty\); give T_targetcarrier_target"
    ):
        rw.refine_corners(given.observations, {}, given.Y)
    with pytest.raises(FrameError, match=r"start Y lacks the sensor cam_1 \(it has cam_0\); give T_sensorcarrier_sen"):
        rw.refine_corners(given.observations, given.X, {"cam_0": given.Y["cam_0"]})
    with pytest.raises(OptionError, match=r"X=None is not a dict"):
        rw.refine_corners(given.observations, None, given.Y)  # type: ignore[arg-type]


def test_arguments_of_another_type_are_named(given: Cell) -> None:
    with pytest.raises(OptionError, match=r"observations=None are not Observations; make them by rw\.Observations\.of"):
        rw.refine_corners(None, given.X, given.Y)  # type: ignore[arg-type]
    with pytest.raises(OptionError, match=r"observations=None"):
        rw.calibrate_corners(None)  # type: ignore[arg-type]
    with pytest.raises(OptionError, match=r"options='exact' are not CornerOptions"):
        rw.calibrate_corners(given.observations, "exact")  # type: ignore[arg-type]


def test_other_failures_stay_what_they_are(given: Cell) -> None:
    found = given.refined()
    with pytest.raises(RuntimeError, match=r"out of paper"), told_where_it_fails(found.graph.model, found.point):
        raise RuntimeError("out of paper")


def test_fewer_corners_than_unknowns() -> None:
    """Two images of four corners; and three, where the board's corners are free too: noise is not told by them."""
    given, four = cell(1, cameras=1, images=12), [0, 6, 28, 34]
    given = replace(given, observations=replace(given.observations, corner_px=0.2))

    def some(view: Views, images: int) -> Views:
        pixels = np.full_like(view.pixels[:images], np.nan)
        pixels[:, four] = view.pixels[:images, four]
        return Views(view.A[:images], pixels)

    exact = rw.CornerOptions(carrier_noise="exact")
    with pytest.raises(UnderdeterminedError, match=r"\(16 coordinates of corners for 20 unknowns\) are too few"):
        refined(given, lambda view: some(view, 2), exact)
    result = refined(given, lambda view: some(view, 3), exact)  # 24 for 20
    assert not any("coordinates of corners" in words for words in result.findings)
    result = refined(given, lambda view: some(view, 3), replace(exact, corners_m=1e-3))
    (words,) = (words for words in result.findings if "coordinates of corners" in words)
    assert words.startswith("There are 24 coordinates of corners for 125 unknowns, which therefore rest on their")
    assert result.noise.corner_px == 0.2


def test_options_of_frames_that_nobody_knows_are_refused() -> None:
    """A misspelt sensor was nominal, and not exact, without a word; cameras of two resolutions were one."""
    given = cell(4, images=12)
    start = given.near(np.random.default_rng(0))
    for options, words in (
        (rw.CornerOptions(stated={"cam0": "exact"}), r"stated names 'cam0'; the sensors are cam_0, cam_1"),
        (rw.CornerOptions(size_share={"Board": 0.1}), r"size_share names 'Board'; the targets are board"),
        (rw.CornerOptions(shared=(("cam_0", "cam_1"), ("cam_1",))), r"shared names 'cam_1' twice"),
    ):
        with pytest.raises(FrameError, match=words):
            rw.refine_corners(given.observations, *start, options)
    larger = replace(given.observations.cameras["cam_1"], width=2400, height=1350)
    two = replace(given.observations, cameras={**given.observations.cameras, "cam_1": larger})
    with pytest.raises(CameraError, match="its images have 2400 x 1350 pixels, and those of the other 1920 x 1080"):
        rw.refine_corners(two, *start, rw.CornerOptions(shared=(("cam_0", "cam_1"),)))
