"""What is doubtful is said in words, with the figure; and nothing where nothing is."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from simulated_cells import CAMERA, Cell, cell

import gtsam_rwhec as rw
from gtsam_rwhec.fitting.corner_findings import findings_of
from gtsam_rwhec.fitting.observations import Views

EXACT = rw.CornerOptions(carrier_noise="exact")


@pytest.fixture(scope="module")
def good() -> Cell:
    return cell(1, images=20)


@pytest.mark.parametrize("options", [rw.CornerOptions(), EXACT], ids=["estimated", "exact"])
def test_nothing_is_doubtful_in_a_good_cell(good: Cell, options: rw.CornerOptions) -> None:
    assert good.refined(options).findings == ()


def test_noise_of_a_good_arm_is_no_finding() -> None:
    assert not any("noise of A" in words for words in cell(2, images=30, carrier=(1e-3, 5e-4)).refined().findings)


def with_a_larger_board(given: Cell) -> Cell:
    corners = {name: 1.1 * points for name, points in given.observations.corners.items()}
    return replace(given, observations=replace(given.observations, corners=corners))


def test_a_wrong_size_shows_as_noise_of_the_carriers(good: Cell) -> None:
    result = with_a_larger_board(good).refined()
    mm = 1e3 * result.noise.carrier_m
    assert f"{mm:.2g} mm, more than an arm or tracker has" in result.findings[0]
    assert "a wrong size of a target" in result.findings[0]


def test_a_wrong_size_shows_as_errors_of_corners_where_a_is_exact(good: Cell) -> None:
    result = with_a_larger_board(good).refined(EXACT)
    assert f"Corners are off by {result.noise.corner_px:.2g} pixels" in result.findings[0]


def test_images_shuffled_against_a_reach_the_bound() -> None:
    given = cell(2, images=14, cameras=1)
    views = {pair: Views(view.A, np.roll(view.pixels, 1, axis=0)) for pair, view in given.observations.views.items()}
    shuffled = replace(given, observations=replace(given.observations, views=views))
    result = shuffled.refined(rw.CornerOptions(stated="calibration"))
    assert result.findings[0].startswith("The noise of A is at its bound (0.1 rad and 0.1 m)")
    assert "Do not use this answer. Likely causes: poses of other images" in result.findings[0]
    number = result.left_out["board", "cam_0"].sum()
    assert any(f"{number} of 490 corners of board by cam_0 disagree" in words for words in result.findings)


def test_exact_intrinsics_are_held_and_it_is_said(good: Cell) -> None:
    off = np.array([28.0, 28.0, 25.0, -20.0, 0.0, 0.0, 0.0, 0.0])
    given = cell(1, images=20, stated_off=off)
    result = given.refined(replace(EXACT, stated="exact"))
    for name, camera in given.observations.cameras.items():
        np.testing.assert_allclose(result.intrinsics[name].camera.K, camera.K, atol=1e-2)
        assert result.intrinsics[name].widened == 1.0
    assert any(words.startswith("The intrinsics of cam_0 are held as stated (exact)") for words in result.findings)


def test_a_calibration_that_is_contradicted_is_named_with_its_deviations() -> None:
    given = cell(5, images=30, stated_off=np.array([28.0, 28.0, 25.0, -20.0, 0.0, 0.0, 0.0, 0.0]))
    result = given.refined(replace(EXACT, stated="calibration"))
    camera = result.intrinsics["cam_0"]
    words = next(words for words in result.findings if "of cam_0: the focal" in words)
    off = camera.innovation.off
    assert f"the focal length is off by {100 * off[:2].mean() / camera.camera.K[0, 0]:+.2g} % (" in words
    assert f"the centre is off by ({off[2]:+.3g}, {off[3]:+.3g}) pixels (" in words
    assert f"({camera.innovation.deviations:.2g} deviations)" in words
    assert f"widened {camera.widened:.3g} times" in words


@pytest.mark.parametrize("stated", ["nominal", "calibration"])
def test_a_lens_that_was_left_out_is_named_with_the_terms_that_fit(good: Cell, stated: str) -> None:
    pinhole = rw.cameras.Camera(1920, 1080, "pinhole", CAMERA.K, np.zeros(0))
    without = replace(good.observations, cameras=dict.fromkeys(good.observations.cameras, pinhole))
    result = replace(good, observations=without).refined(replace(EXACT, stated=stated))
    lens = [words for words in result.findings if "have no distortion" in words]
    assert len(lens) == 2
    camera = result.intrinsics["cam_0"]
    assert "of cam_0 have no distortion, and the images show one: a distortion that moves corners by up to " in lens[0]
    ratios = np.abs(camera.camera.D) / np.array(camera.standard_deviations[4:])
    surest = int(ratios.argmax())
    assert ratios[surest] > 3.0
    assert f" fits ({camera.names[4 + surest]} = {camera.camera.D[surest]:.3g} +- " in lens[0]
    assert result.intrinsics["cam_0"].camera.D[0] == pytest.approx(CAMERA.D[0], abs=0.01)
    assert not any("contradict" in words for words in result.findings)


def test_a_lens_without_distortion_is_none(good: Cell) -> None:
    bare = rw.cameras.Camera(1920, 1080, "pinhole", CAMERA.K, np.zeros(0))
    given = cell(1, images=20, camera=bare)
    assert given.refined(EXACT).findings == ()


def test_cameras_that_share_intrinsics_are_named_together(good: Cell) -> None:
    options = rw.CornerOptions(stated="calibration", carrier_noise="exact", shared=(("cam_0", "cam_1"),))
    off = cell(5, images=20, stated_off=np.array([28.0, 28.0, 25.0, -20.0, 0.0, 0.0, 0.0, 0.0]))
    found = [words for words in off.refined(options).findings if "contradict" in words]
    assert len(found) == 1
    assert "of cam_0, cam_1: the focal" in found[0]


def test_what_only_the_prior_holds_is_named() -> None:
    result = cell(7, images=3, cameras=1).refined(replace(EXACT, stated="calibration"))
    held = ", ".join(result.intrinsics["cam_0"].held_by_prior)
    assert any(f"do not tell {held} of cam_0" in words for words in result.findings)


def test_an_optimiser_that_stopped_early_is_named(good: Cell) -> None:
    far = good.near(np.random.default_rng(9), 0.05)
    once = rw.CornerOptions(carrier_noise=rw.CarrierNoise(1e-3, 1e-3), max_iterations=1)
    result = rw.refine_corners(good.observations, *far, once)
    assert findings_of(replace(result, last_step=0.05), once) == tuple(w for w in result.findings if "conv" not in w)
    words = " ".join(findings_of(replace(result, last_step=0.37), once))
    assert "The optimiser has not converged: one more step would move the answer by 0.37" in words
    assert "max_iterations=1" in words
    assert "not converged" in " ".join(findings_of(replace(result, last_step=float("nan")), once))


def test_images_of_one_instant_that_disagree_do_not_come_and_go() -> None:
    """Two cameras at one place: three images of one are half a pixel off, and the noise settles all the same."""
    given = cell(1, images=40, cameras=1, carrier=(1e-3, 5e-4), corner_px=0.02)
    of, view, rng = given.observations, given.observations.views["board", "cam_0"], np.random.default_rng(1)
    pixels = view.pixels + rng.normal(0.0, 0.02, view.pixels.shape)
    pixels[:3] += 0.5
    cameras = dict.fromkeys(("cam_0", "cam_1"), of.cameras["cam_0"])
    views = {("board", "cam_0"): (view.A, view.pixels), ("board", "cam_1"): (view.A, pixels)}
    said: list[str] = []
    result = rw.refine_corners(
        rw.Observations.of(cameras, of.corners, views), given.X, dict.fromkeys(cameras, given.Y["cam_0"]),
        progress=said.append,
    )  # fmt: skip
    assert len(said) < 12
    assert all(mask[3:].mean() < 0.01 for mask in result.left_out.values())
