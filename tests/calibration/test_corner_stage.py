"""The stage that refines from corners: which model is chosen, and what is said."""

from __future__ import annotations

import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from rwhec_factors import se3

import gtsam_rwhec as rw
from gtsam_rwhec.calibration import corner_models
from gtsam_rwhec.calibration.corner_models import chosen_model, growth_by_intrinsics, in_words, thinned
from gtsam_rwhec.calibration.from_corners import MEASUREMENTS, corners_found
from gtsam_rwhec.calibration.verdict import Ground

sys.path.insert(0, str(Path(__file__).parents[1] / "fitting"))
from simulated_cells import Cell, cell  # isort: skip


def silent(_: str) -> None:
    """No progress."""


def start(given: Cell) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
    return given.near(np.random.default_rng(0))


def with_bent_arm(given: Cell) -> rw.Observations:
    """The carriers' poses with an error that varies with the configuration, up to 3 mm."""
    views = {}
    for pair, view in given.observations.views.items():
        at = view.A[:, :3, 3] - view.A[:, :3, 3].mean(axis=0)
        xi = np.zeros((len(view.A), 6))
        xi[:, 3:] = 3e-3 * np.tanh(at[:, [1, 2, 0]] / 0.2)
        views[pair] = (view.A @ se3.expmap(xi), view.pixels)
    of = given.observations
    return rw.Observations.of(of.cameras, of.corners, views, of.corner_px)


def test_exact_and_noisy_poses_are_told_apart_by_images_that_were_left_out() -> None:
    exact, noisy = cell(3, images=24), cell(3, images=24, carrier=(2e-3, 1e-3))
    for given, px in ((exact, 0.3), (noisy, 6.0)):
        tried = chosen_model(given.observations, *start(given), rw.CornerOptions(), silent)
        assert {score.words for score in tried.scores} == {
            "A's noise estimated and sizes as stated", "A as exact and sizes as stated",
        }  # fmt: skip
        assert tried.scores[0].px < px
        # an error that is as large as the covariances say is no finding
        assert 0.6 < tried.scores[0].px / tried.scores[0].expected_px < 1.4
    assert tried.options.carrier_noise == "estimate"


@pytest.mark.parametrize(("shares", "said"), [
    ({"tag_0": 0.05, "tag_1": 0.0}, "the size of tag_0 estimated"),
    ({"tag_0": 0.05, "tag_1": 0.05}, "some sizes estimated"),
    (0.05, "sizes estimated"),
])  # fmt: skip
def test_one_size_that_is_free_is_named(shares: dict[str, float] | float, said: str) -> None:
    assert in_words(rw.CornerOptions(size_share=shares)) == f"A's noise estimated and {said}"


def test_what_is_chosen_and_found_is_said() -> None:
    given = cell(4, images=24, carrier=(5e-4, 2e-4), stated="calibration")
    found = corners_found(*start(given), given.observations, rw.CornerOptions(stated="calibration"), silent)
    assert found.corners is not None
    assert found.reprojection is not None
    assert found.findings == ()
    assert found.contradicted == ()
    chosen = {choice.what: str(choice) for choice in found.choices if choice.what != "standard deviations"}
    of_cameras = ["camera model of cam_0", "camera model of cam_1", "intrinsics of cam_0", "intrinsics of cam_1"]
    assert list(chosen) == [MEASUREMENTS, "shape of board", *of_cameras]
    assert "a calibration states them" in chosen["intrinsics of cam_0"]
    sensors = found.reprojection.sensors
    assert sum(one.images for one in sensors.values()) == sum(len(view.A) for view in given.observations.views.values())
    assert all(one.held_out_px is not None and one.expected_px is not None for one in sensors.values())
    assert found.reprojection.rms_px < 0.12
    assert found.reprojection.carrier_poses == "estimated"
    assert {one.frame for one in found.reprojection.consequences} == {"board", "cam_0", "cam_1"}


def test_the_growth_by_free_intrinsics_is_that_against_exact_ones() -> None:
    given = cell(4, images=24)
    options = rw.CornerOptions(stated="calibration", carrier_noise="exact")
    free, exact = (rw.refine_corners(given.observations, *start(given), each) for each in (
        options, rw.CornerOptions(stated="exact", carrier_noise="exact"),
    ))  # fmt: skip
    for name, growth in growth_by_intrinsics(free).items():
        before, after = (np.sqrt(np.diagonal(each.covariance(name))) / each.noise.corner_px for each in (exact, free))
        assert growth == pytest.approx((after / before).max(), rel=0.02)
        assert growth > 1.5
    assert growth_by_intrinsics(exact) == pytest.approx({"cam_0": 1.0, "cam_1": 1.0})


def test_stated_intrinsics_that_are_off_are_named() -> None:
    off = np.array([0.0, 0.0, 25.0, 0.0, 0.0, 0.0, 0.0, 0.0])
    given = cell(5, images=24, stated_off=off)
    found = corners_found(*start(given), given.observations, rw.CornerOptions(stated="calibration"), silent)
    assert set(found.contradicted) == {"cam_0", "cam_1"}
    assert {one.ground for one in found.findings} == {Ground.INTRINSICS_ESTIMATED}
    assert "cx, cy = 985, 540" in found.findings[0].words
    assert "cx, cy = 960" in found.findings[0].words
    (choice,) = (one for one in found.choices if one.what == "intrinsics of cam_0")
    assert choice.evidence.startswith("the stated ones are contradicted by ")
    assert "a calibration states them" not in choice.evidence
    assert choice.evidence.endswith(f"{found.intrinsics['cam_0'].widened:.2g} times as wide")


def test_exact_intrinsics_that_the_corners_contradict_are_named() -> None:
    """Held as exact, f that is 10 % off gave poses that are 166 mm off, and nothing was said."""
    off = np.array([140.0, 140.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0])
    of = {"cameras": 1, "images": 16, "carrier": (5e-4, 2e-4)}
    exact = rw.CornerOptions(stated="exact")
    right, wrong = cell(1, **of), cell(1, stated_off=off, **of)  # type: ignore[arg-type]
    assert corners_found(*start(right), right.observations, exact, silent).findings == ()
    found = corners_found(*start(right), wrong.observations, exact, silent)
    assert found.corners is not None
    assert Ground.INTRINSICS_DOUBTED in {one.ground for one in found.findings}


def test_corners_that_do_not_fit_together_speak_against_poses_too() -> None:
    """A third of the corners read at their neighbours' places: the poses of the same corners are wrong."""
    given = cell(1, cameras=1, images=16, carrier=(5e-4, 2e-4))
    view = given.observations.views["board", "cam_0"]
    pixels = view.pixels.copy()
    pixels[np.random.default_rng(0).random(pixels.shape[:2]) < 0.3] += [8.0, 3.0]
    of = given.observations
    misread = rw.Observations.of(of.cameras, of.corners, {("board", "cam_0"): (view.A, pixels)}, of.corner_px)
    found = corners_found(*start(given), misread, rw.CornerOptions(), silent)
    assert found.corners is None
    assert {one.ground for one in found.findings} == {Ground.CORNERS_DOUBTED}
    assert "more than a detector's noise" in found.findings[0].words


def test_a_bent_arm_is_named() -> None:
    given = cell(6, images=24)
    found = corners_found(*start(given), with_bent_arm(given), rw.CornerOptions(carrier_noise="exact"), silent)
    assert Ground.SYSTEMATIC in {one.ground for one in found.findings}


def test_few_images_are_not_left_out_and_nonsense_gives_nothing() -> None:
    few = cell(7, cameras=1, images=7)
    found = corners_found(*start(few), few.observations, rw.CornerOptions(carrier_noise="exact"), silent)
    assert found.reprojection is not None
    assert found.reprojection.tried == ()
    assert "no other was tried: 7 instants cannot be left out in 8 blocks" in str(found.choices[0])
    X, Y = start(few)
    turned = {name: T @ np.diag([1.0, -1.0, -1.0, 1.0]) for name, T in Y.items()}
    nothing = corners_found(X, turned, few.observations, rw.CornerOptions(), silent)
    assert nothing.corners is None
    assert "behind" in str(nothing.choices[0])
    assert [one.ground for one in nothing.findings] == [Ground.CORNERS_DOUBTED]
    assert "take the stated intrinsics as exact" in nothing.findings[0].words


def test_many_images_are_thinned_evenly() -> None:
    given = cell(8, cameras=1, images=300)
    some = thinned(given.observations)
    view = some.views["board", "cam_0"]
    assert len(view.A) == 120
    np.testing.assert_array_equal(view.A[[0, -1]], given.observations.views["board", "cam_0"].A[[0, -1]])


@pytest.mark.parametrize(("stated", "number"), [("nominal", 1), ("unknown", 0)])
def test_intrinsics_that_nobody_stated_are_not_called_wrong(
    stated: str, number: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(corner_models, "lens_that_was_left_out", lambda *_: "")
    camera = rw.Camera.of(640, 480, "pinhole", np.diag([500.0, 500.0, 1.0]), np.zeros(0), "camera")
    one: Any = SimpleNamespace(stated_as=stated, stated_camera=camera, camera=camera)
    innovation = SimpleNamespace(is_contradicted=True, deviations=6.6)
    corners: Any = SimpleNamespace(intrinsics={"camera": SimpleNamespace(innovation=innovation)}, Y={})
    tried: Any = SimpleNamespace(unexplained=0.0, options=None)
    observations: Any = None
    assert len(list(corner_models.findings_of(observations, corners, tried, {"camera": one}))) == number
