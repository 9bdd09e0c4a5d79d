"""The simplest camera and board that explain images: what is chosen, and that errors shrink and stay plausible."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from rwhec_factors import se3
from simulated_cells import CAMERA, Cell, cell

import gtsam_rwhec as rw
from gtsam_rwhec.calibration.corner_models import chosen_model
from gtsam_rwhec.cameras.camera import Camera
from gtsam_rwhec.cameras.targets import Checkerboard
from gtsam_rwhec.files.progress import silent
from gtsam_rwhec.fitting.camera_choice import Blocks, ChosenCameras, LinearModel, chosen_cameras, with_widest
from gtsam_rwhec.fitting.corner_noise import Reduced
from gtsam_rwhec.fitting.corners_refined import CornersRefined
from gtsam_rwhec.fitting.stated_intrinsics import ASPECT, free_model, prior_of

PINHOLE = Camera.of(
    1920, 1080, "pinhole", [[1371.0, 0.0, 959.5], [0.0, 1371.0, 539.5], [0.0, 0.0, 1.0]], [], "a camera"
)
SMALL = Checkerboard("board", 4, 3, 0.05)
#: The centre is stated a pixel off.
OFF = np.array([0.0, 0.0, 1.0, 1.0])


def wide_and_chosen(given: Cell, options: rw.CornerOptions) -> tuple[CornersRefined, ChosenCameras]:
    wide = rw.refine_corners(given.observations, given.X, given.Y, with_widest(options, given.observations))
    return wide, chosen_cameras(wide, given.observations, options)


def errors(refined: CornersRefined, given: Cell) -> np.ndarray:
    """Logarithms (sensors, 6) of the errors of the sensors' poses."""
    return se3.logmap(np.array([se3.inverse(given.Y[name]) @ T.matrix() for name, T in refined.Y.items()]))


def four(seed: int) -> Cell:
    """Four cameras of one pinhole; a small board."""
    return cell(
        seed, images=100, cameras=4, camera=PINHOLE, board=SMALL, stated_off=OFF, carrier=(2e-4, 1e-4), corner_px=0.03
    )


@cache
def chosen_of_four(seed: int) -> tuple[Cell, CornersRefined, ChosenCameras]:
    given = four(seed)
    return given, *wide_and_chosen(given, rw.CornerOptions())


@pytest.mark.parametrize("seed", [0, 1])
def test_four_alike_pinholes_share_one_focal_length_and_their_errors_shrink(seed: int) -> None:
    given, wide, chosen = chosen_of_four(seed)
    assert chosen.options.shared == (("cam_0", "cam_1", "cam_2", "cam_3"),)
    assert {chosen.options.lens_of(name) for name in given.Y} <= {"focal", "focals"}
    assert chosen.options.warp_m == {}
    simple = rw.refine_corners(given.observations, given.X, given.Y, chosen.options)
    free, found = errors(wide, given), errors(simple, given)
    assert np.linalg.norm(found[:, :3]) < 0.5 * np.linalg.norm(free[:, :3])
    for name, xi in zip(simple.Y, found, strict=True):
        assert xi @ np.linalg.solve(simple.covariance(name), xi) < 25.0
    camera = simple.intrinsics["cam_0"].camera
    assert camera.K[0, 0] == pytest.approx(camera.K[1, 1], abs=0.02)
    assert camera.model == "pinhole"


def test_cameras_that_differ_are_not_one_though_they_are_stated_alike() -> None:
    given = four(0)
    views = dict(given.observations.views)
    # a camera whose centre is 12 pixels elsewhere
    moved = {at: (v.A, v.pixels + (12.0 if at[1] == "cam_1" else 0.0)) for at, v in views.items()}
    of = given.observations
    observations = rw.Observations.of(of.cameras, of.corners, moved, of.corner_px)
    wide = rw.refine_corners(observations, given.X, given.Y, with_widest(rw.CornerOptions(), observations))
    chosen = chosen_cameras(wide, observations, rw.CornerOptions())
    assert chosen.options.shared == ()
    assert {one.what for one in chosen.tried if one.is_chosen} >= {f"camera model of cam_{i}" for i in range(4)}


def test_a_lens_that_the_images_show_is_free() -> None:
    bending = Camera.of(1920, 1080, "radtan", PINHOLE.K, [-0.12, 0.03, 0.0, 0.0], "a camera")
    given = cell(3, images=60, cameras=1, camera=bending, stated_off=np.array([0, 0, 1, 1, 0.12, -0.03, 0, 0]))
    _, chosen = wide_and_chosen(given, rw.CornerOptions())
    lens = chosen.options.lens_of("cam_0")
    assert lens in ("k1", "k2", "p2", "k3")
    found = rw.refine_corners(given.observations, given.X, given.Y, rw.CornerOptions(lens="k1")).intrinsics["cam_0"]
    assert found.not_free == ("k2", "p1", "p2")
    assert not set(found.held_by_prior) & set(found.not_free)
    errors_px = {one.words: one.px for one in chosen.tried if one.what == "camera model of cam_0"}
    assert errors_px["one focal length and the centre"] > 1.5 * min(errors_px.values())


def test_a_rational_lens_is_tried_where_k3_is_not_enough() -> None:
    wide = [1.2, 0.4, 0.0, 0.0, 0.02, 1.6, 0.9, 0.1]
    rational = Camera.of(1280, 960, "radtan", [[640.0, 0, 640], [0, 640.0, 480], [0, 0, 1]], wide, "a camera")
    given = cell(3, images=64, cameras=1, camera=rational, corner_px=0.02, distance=0.7)
    pinhole = Camera.of(1280, 960, "pinhole", rational.K, [], "a camera")
    observations = replace(given.observations, cameras={"cam_0": pinhole})
    tried = chosen_model(observations, given.X, given.Y, rw.CornerOptions(), silent)
    assert tried.options.lens_of("cam_0") == "rational"
    px = {one.words: one.px for one in tried.cameras.tried if one.what == "camera model of cam_0"}
    assert px["a rational lens, with k1 to k6, p1 and p2"] < px["with k1, k2, p1, p2 and k3"]
    found = rw.refine_corners(observations, given.X, given.Y, tried.options)
    assert np.linalg.norm(errors(found, given)[:, 3:]) < 1e-3
    assert len(found.intrinsics["cam_0"].camera.D) == 8


def test_k1_and_k2_go_against_each_other() -> None:
    prior = prior_of(free_model(PINHOLE, "nominal", "k3"), "nominal", "k3")
    C = np.linalg.inv(prior.precision)
    k1, k2, k3 = 4, 5, 8
    size = np.sqrt(np.diagonal(C))
    assert size[k1:] == pytest.approx(prior.deviation[k1:])
    assert C[k1, k2] / size[k1] / size[k2] == pytest.approx(-0.86)
    assert C[k1, k3] == pytest.approx(0.0, abs=1e-12)
    alone = prior_of(free_model(PINHOLE, "nominal", "k1"), "nominal", "k1")
    assert alone.opposed == ()


def test_from_images_that_are_too_few_to_leave_some_out_nothing_more_is_free() -> None:
    given = cell(3, images=4, cameras=1, camera=PINHOLE, stated_off=OFF)
    _, chosen = wide_and_chosen(given, rw.CornerOptions())
    assert chosen.options.lens_of("cam_0") == "focal"
    assert chosen.options.warp_m_of("board") == 0.0
    _, unknown = wide_and_chosen(given, rw.CornerOptions(stated="unknown"))
    assert unknown.options.lens_of("cam_0") == "k1"


def test_models_of_a_fisheye_have_the_names_of_its_coefficients() -> None:
    fisheye = Camera.of(1920, 1080, "equidistant", PINHOLE.K, [0.02, -0.01, 0.0, 0.0], "a camera")
    _, chosen = wide_and_chosen(cell(3, images=40, cameras=1, camera=fisheye), rw.CornerOptions())
    words = {one.words for one in chosen.tried if one.what == "camera model of cam_0"}
    assert "with k1, k2" in words
    assert not any("p1" in each or "rational" in each for each in words)


def test_noise_of_the_carriers_is_not_taken_for_that_of_corners_by_chance() -> None:
    """Corners that go together with A's noise would count one by one: deviations ten times too small."""
    for seed in range(5):
        given = cell(seed, images=20, cameras=1, carrier=(4e-4, 1e-4), corner_px=0.02)
        tried = chosen_model(given.observations, given.X, given.Y, rw.CornerOptions(), silent)
        assert tried.options.carrier_noise == "estimate"
        exact = rw.CornerOptions(carrier_noise="exact")
        widened = chosen_model(given.observations, given.X, given.Y, exact, silent).wider["y", "cam_0"]
        assert widened > 2.0


@pytest.mark.parametrize("seed", [1, 2, 5])
def test_what_the_simplest_lens_lacks_is_in_the_covariance(seed: int) -> None:
    """p1 and p2 that images hardly tell are left out, and how far they would move the camera is counted."""
    bending = Camera.of(1920, 1080, "radtan", PINHOLE.K, [-0.12, 0.03, 2e-4, -2e-4], "a camera")
    given = cell(seed, images=16, cameras=1, camera=bending, board=SMALL, carrier=(2e-4, 1e-4), corner_px=0.03)
    pinhole = replace(given.observations, cameras={"cam_0": PINHOLE})
    tried = chosen_model(pinhole, given.X, given.Y, rw.CornerOptions(stated="unknown"), silent)
    assert tried.options.lens_of("cam_0") == "k1"
    corners = rw.refine_corners(pinhole, given.X, given.Y, tried.options)
    more, pose = tried.covariance_of_rivals(corners), corners.slots["y", "cam_0"]
    xi = se3.logmap(se3.inverse(corners.Y["cam_0"].matrix())[None] @ given.Y["cam_0"])[0]
    alone, with_rivals = (float(xi @ np.linalg.solve(C[pose, pose], xi)) for C in (corners.joint, corners.joint + more))
    assert with_rivals < 0.8 * alone
    # noise moves rivals less where more images are refined from than were looked at
    twice_as_many = replace(tried, images=tried.images // 2).covariance_of_rivals(corners)
    np.testing.assert_allclose(twice_as_many, 0.5 * more, rtol=1e-9, atol=1e-20)


def test_a_bent_board_is_found_bent_and_a_flat_one_flat() -> None:
    bent = cell(2, images=60, shape=(0.0, 1e-3, 1e-3), carrier=(2e-4, 1e-4))
    _, chosen = wide_and_chosen(bent, rw.CornerOptions())
    assert chosen.options.warp_m_of("board") > 0.0
    flat = cell(2, images=60, carrier=(2e-4, 1e-4))
    _, chosen = wide_and_chosen(flat, rw.CornerOptions())
    assert chosen.options.warp_m_of("board") == 0.0


def test_what_options_say_is_not_chosen_again() -> None:
    given = cell(1, images=40)
    options = rw.CornerOptions(lens="k1", shared=(("cam_0", "cam_1"),), warp_m=1e-3)
    _, chosen = wide_and_chosen(given, options)
    assert chosen.options == options
    assert chosen.tried == ()


def test_the_linear_answer_is_the_nonlinear_one() -> None:
    """What is held, and shared, by linear algebra about the wide answer is where a refinement of its own ends."""
    given = four(1)
    wide, chosen = wide_and_chosen(given, rw.CornerOptions(carrier_noise="exact"))
    blocks = Blocks.of(wide)
    model = LinearModel.of(wide, given.observations.cameras, chosen.options)
    theta = model.theta(blocks.all)
    own = rw.refine_corners(given.observations, given.X, given.Y, chosen.options)
    rows = wide.slots["k", "cam_2"]
    at = wide.point.cameras["cam_2"] + theta[rows]
    off = np.abs(wide.intrinsics["cam_2"].camera.K[:2, 2] - own.intrinsics["cam_2"].camera.K[:2, 2])
    assert at[2:4] == pytest.approx(own.intrinsics["cam_2"].camera.K[:2, 2], abs=max(0.1 * off.max(), 0.1))
    assert at[4:] == pytest.approx(np.zeros(5), abs=1e-6)


def test_the_blocks_are_the_whole() -> None:
    _, wide, _ = chosen_of_four(0)
    blocks = Blocks.of(wide)
    whole = Reduced.of(wide.graph.model, wide.point).without_carriers(wide.noise)
    for way in (0, 1):
        assert blocks.H[blocks.way == way].sum(axis=0) == pytest.approx(
            whole.H, rel=1e-6, abs=1e-3 * np.abs(whole.H).max()
        )
        assert blocks.c[blocks.way == way].sum() == pytest.approx(whole.rr, rel=1e-9)


def test_blocks_of_independent_images_scatter_as_the_covariance_says() -> None:
    """Also where the images of one camera come after those of the other: each block has a part of both."""
    factors = []
    for seed in range(6):
        _, _, chosen = chosen_of_four(seed)
        factors += [factor for (letter, _), factor in chosen.spread.items() if letter in "xy"]
    assert np.mean(np.array(factors) > 1.0) <= 0.1


def test_no_lens_that_is_sold_has_other_focal_lengths() -> None:
    prior = prior_of(CAMERA, "nominal")
    covariance = np.linalg.inv(prior.precision)
    row = np.array([-1.0, 1.0]) / prior.mean[:2]
    assert np.sqrt(row @ covariance[:2, :2] @ row) == pytest.approx(ASPECT, rel=0.01)
    assert np.sqrt(covariance[0, 0]) / prior.mean[0] == pytest.approx(0.03 / np.sqrt(2.0), rel=0.01)


def test_blocks_of_images_disagree_as_covariances_say_unless_the_arm_is_bent() -> None:
    given = cell(5, images=48)
    exact = rw.CornerOptions(carrier_noise="exact")
    _, chosen = wide_and_chosen(given, exact)
    assert set(chosen.spread) == {("x", "board"), ("b", "board"), *((k, f"cam_{i}") for k in "yk" for i in range(2))}
    assert max(chosen.spread.values()) < 2.0
    views = {}
    for pair, view in given.observations.views.items():
        xi = np.zeros((len(view.A), 6))
        xi[:, 3:] = 4e-3 * np.tanh((view.A[:, :3, 3] - view.A[:, :3, 3].mean(axis=0))[:, [1, 2, 0]] / 0.2)
        views[pair] = (view.A @ se3.expmap(xi), view.pixels)
    bent = rw.Observations.of(given.observations.cameras, given.observations.corners, views)
    wide = rw.refine_corners(bent, given.X, given.Y, with_widest(exact, bent))
    assert max(chosen_cameras(wide, bent, exact).spread.values()) > 2.0
