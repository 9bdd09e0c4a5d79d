"""Refinement from corners: truth, noise, wrong intrinsics, outliers, images that come back or are left out, words."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from scipy.stats import chi2
from simulated_cells import CAMERA, Cell, cell

import gtsam_rwhec as rw
from gtsam_rwhec.calibration.calibrate_options import Run
from gtsam_rwhec.calibration.clock_offsets import Answer
from gtsam_rwhec.calibration.from_corners import answered_by_corners
from gtsam_rwhec.errors import CameraError, CountError, FrameError, OptionError
from gtsam_rwhec.files.progress import silent
from gtsam_rwhec.fitting.held_out import held_out_errors
from gtsam_rwhec.fitting.observations import Views
from gtsam_rwhec.fitting.readmission import agreeing_by_corners
from gtsam_rwhec.fitting.stated_intrinsics import CameraPrior, innovation_of, wider


def squared_deviations(given: Cell, result: rw.CornersRefined) -> tuple[float, int]:
    """Of all unknowns together: chi-square of their number."""
    errors = [given.error(result, name) for name in (*result.X, *result.Y)]
    errors += [given.cameras[name].parameters - result.intrinsics[name].camera.parameters for name in result.Y]
    names = [*result.X, *result.Y, *(f"intrinsics:{name}" for name in result.Y)]
    if "shape:board" in result.names:
        errors.append(given.shape - result.shapes["board"])
        names.append("shape:board")
    error = np.concatenate(errors)
    return float(error @ np.linalg.solve(result.covariance(*names), error)), len(error)


def test_exact_corners_give_the_truth() -> None:
    given = cell(1, corner_px=1e-9, images=12)
    result = given.refined(rw.CornerOptions(carrier_noise="exact"))
    for name in ("board", "cam_0", "cam_1"):
        assert np.abs(given.error(result, name)).max() < 1e-6
    assert result.intrinsics["cam_0"].camera.parameters == pytest.approx(CAMERA.parameters, abs=1e-4)


@pytest.mark.parametrize("about", ["targetcarrier", "sensorcarrier"])
def test_noise_is_found_and_everything_is_within_its_covariance(about: str) -> None:
    given = cell(2, images=40, stated="calibration", carrier=(1e-3, 5e-4), shape=(1e-3, 1e-3, 1e-3))
    options = rw.CornerOptions(stated="calibration", size_share=1e-3, warp_m=1e-3, about=about)  # type: ignore[arg-type]
    result = given.refined(options)
    assert result.noise.corner_px == pytest.approx(0.1, rel=0.05)
    if about == "targetcarrier":
        assert result.noise.carrier_rad == pytest.approx(1e-3, rel=0.3)
        assert result.noise.carrier_m == pytest.approx(5e-4, rel=0.3)
        squares, number = squared_deviations(given, result)
        assert chi2.ppf(0.001, number) < squares < chi2.ppf(0.999, number)
    assert result.last_step < 1e-3
    assert (
        not any(mask.any() for mask in result.left_out.values()) or sum(m.sum() for m in result.left_out.values()) < 3
    )


def test_a_warped_board_of_known_size() -> None:
    given = cell(2, images=20, shape=(0.0, 1e-3, 1e-3))
    result = given.refined(rw.CornerOptions(carrier_noise="exact", warp_m=1e-3))
    assert result.shapes["board"][0] == 0.0
    assert result.shapes["board"][1:] == pytest.approx(given.shape[1:], abs=3e-4)
    error = given.shape[1:] - result.shapes["board"][1:]
    assert error @ np.linalg.solve(result.covariance("shape:board"), error) < chi2.ppf(0.999, 3)


def test_nominal_intrinsics_that_are_off_do_not_move_the_poses_beyond_their_covariance() -> None:
    given = cell(5, images=30, stated_off=np.array([28.0, 28.0, 25.0, -20.0, 0.0, 0.0, 0.0, 0.0]))
    result = given.refined(rw.CornerOptions(carrier_noise="exact"))
    squares, number = squared_deviations(given, result)
    assert squares < chi2.ppf(0.999, number)
    assert result.intrinsics["cam_0"].widened == 1.0


def test_a_calibration_that_the_images_contradict_is_widened_and_said() -> None:
    given = cell(5, images=30, stated_off=np.array([28.0, 28.0, 25.0, -20.0, 0.0, 0.0, 0.0, 0.0]))
    result = given.refined(rw.CornerOptions(stated="calibration", carrier_noise="exact"))
    intrinsics = result.intrinsics["cam_0"]
    assert intrinsics.widened > 1.0
    assert intrinsics.innovation.is_contradicted
    assert intrinsics.innovation.deviations > 5.0
    squares, number = squared_deviations(given, result)
    assert squares < chi2.ppf(0.999, number)


def test_a_pinhole_that_nobody_calibrated_may_have_distortion() -> None:
    given = cell(6, images=30)
    pinhole = rw.cameras.Camera(1920, 1080, "pinhole", CAMERA.K, np.zeros(0))
    stated = replace(given.observations, cameras=dict.fromkeys(given.observations.cameras, pinhole))
    result = replace(given, observations=stated).refined(rw.CornerOptions(carrier_noise="exact"))
    assert pytest.approx(CAMERA.D, abs=0.02) == result.intrinsics["cam_0"].camera.D
    squares, number = squared_deviations(given, result)
    assert squares < chi2.ppf(0.999, number)


def test_what_one_flat_view_cannot_tell_is_held_by_the_prior() -> None:
    given = cell(7, images=3, cameras=1)
    result = given.refined(rw.CornerOptions(stated="calibration", carrier_noise="exact"))
    assert result.intrinsics["cam_0"].held_by_prior
    deviations = np.sqrt(np.diagonal(result.covariance("intrinsics:cam_0")))
    assert (deviations <= result.intrinsics["cam_0"].prior.deviation * (1.0 + 1e-9)).all()


def test_cameras_of_one_model_may_share_their_intrinsics() -> None:
    given = cell(8, images=30, stated="calibration")
    options = rw.CornerOptions(stated="calibration", carrier_noise="exact", shared=(("cam_0", "cam_1"),))
    shared, apart = given.refined(options), given.refined(replace(options, shared=()))
    first, second = (shared.intrinsics[name].camera.parameters for name in ("cam_0", "cam_1"))
    assert np.array_equal(first, second)
    better = np.diagonal(shared.intrinsics["cam_0"].covariance) < np.diagonal(apart.intrinsics["cam_0"].covariance)
    assert better.all()


def test_a_shared_camera_must_be_one_of_the_sensors() -> None:
    with pytest.raises(FrameError, match="shared names 'cam_9'; the sensors are cam_0, cam_1"):
        cell(0, images=5).refined(rw.CornerOptions(shared=(("cam_9", "cam_0"),)))


def test_a_tenth_of_misread_corners_is_left_out() -> None:
    given = cell(10, images=30, carrier=(1e-3, 5e-4))
    rng = np.random.default_rng(0)
    views, wrong = {}, {}
    for pair, view in given.observations.views.items():
        wrong[pair] = rng.random(view.pixels.shape[:2]) < 0.1
        views[pair] = replace(
            view, pixels=view.pixels + wrong[pair][..., None] * rng.normal(scale=20.0, size=view.pixels.shape)
        )
    result = replace(given, observations=replace(given.observations, views=views)).refined()
    for pair, mask in wrong.items():
        assert (result.left_out[pair] & ~mask).sum() <= 2
        assert (mask & ~result.left_out[pair]).sum() <= 2  # some are off by less than their limit
    assert result.noise.corner_px == pytest.approx(0.1, rel=0.1)
    squares, number = squared_deviations(given, result)
    assert squares < chi2.ppf(0.999, number)


def test_intrinsics_are_no_worse_than_opencvs_and_better_with_the_arm_known() -> None:
    ours, theirs = [], []
    for seed in range(5):
        given = cell(20 + seed, images=12, cameras=1, stated="nominal")
        result = given.refined(rw.CornerOptions(carrier_noise="exact"))
        view = given.observations.views["board", "cam_0"]
        points = [given.observations.corners["board"].astype(np.float32)] * len(view.A)
        stated = given.observations.cameras["cam_0"]
        flags = cv2.CALIB_USE_INTRINSIC_GUESS | cv2.CALIB_FIX_K3
        _, K, _, _, _ = cv2.calibrateCamera(
            points,
            list(view.pixels.astype(np.float32)),
            (1920, 1080),
            stated.K.copy(),
            np.pad(stated.D, (0, 1)),
            flags=flags,
        )
        truth = CAMERA.parameters[:4]
        ours.append(result.intrinsics["cam_0"].camera.parameters[:4] - truth)
        theirs.append(np.array([K[0, 0], K[1, 1], K[0, 2], K[1, 2]]) - truth)
    assert np.square(ours).mean() < 0.7 * np.square(theirs).mean()


def test_a_start_behind_a_camera_is_refused() -> None:
    given = cell(1, images=5)
    turned = {name: T @ np.diag([1.0, -1.0, -1.0, 1.0]) for name, T in given.Y.items()}
    with pytest.raises(CameraError, match=r"puts \d+ of \d+ corners of board behind cam_0, .* corner 0 of image 0, at"):
        rw.refine_corners(given.observations, given.X, turned)


def test_names_and_options_are_checked() -> None:
    given = cell(0, images=5)
    with pytest.raises(
        FrameError, match="'cam_9' is not among the unknowns; they are board, cam_0, cam_1, intrinsics:cam_0"
    ):
        given.refined().covariance("cam_9")
    for wrong in ({"stated": "guessed"}, {"stated": {"cam_0": "guessed"}}, {"about": "base"}, {"warp_m": -1.0},
                  {"carrier_noise": "some"}, {"max_iterations": 0}):  # fmt: skip
        with pytest.raises(OptionError, match=next(iter(wrong))):
            rw.CornerOptions(**wrong)  # type: ignore[arg-type]


def test_ellipsoids_are_wider_where_the_carriers_noise_was_estimated_from_few_images() -> None:
    few, many = (cell(3, images=n, carrier=(1e-3, 5e-4)).refined() for n in (12, 60))
    known = cell(3, images=12, carrier=(1e-3, 5e-4)).refined(
        rw.CornerOptions(carrier_noise=rw.CarrierNoise(1e-3, 5e-4))
    )
    chi_square = chi2.ppf(0.95, 6)
    assert few.squared_radius("board") > many.squared_radius("board") > chi_square
    assert known.squared_radius("board") == pytest.approx(chi_square, rel=0.02)
    with pytest.raises(OptionError, match="between 0 and 1"):
        few.squared_radius("board", 95.0)


def test_an_innovation_counts_only_what_the_images_tell() -> None:
    prior, posterior = CameraPrior(np.zeros(2), np.ones(2)), np.diag([0.01, 0.999])
    assert innovation_of(np.array([0.0, 100.0]), prior, posterior).probability == 1.0
    assert innovation_of(np.array([5.0, 0.0]), prior, posterior).deviations == pytest.approx(
        5.0 / np.sqrt(0.99), rel=1e-3
    )


def test_a_centre_that_is_off_does_not_drown_among_other_parameters() -> None:
    off, prior = np.array([0.0, 0.0, 3.5, 1.5, *np.zeros(8)]), CameraPrior(np.zeros(12), np.ones(12))
    found = innovation_of(off, prior, np.diag(np.full(12, 0.01)))
    assert found.contradicted == ("centre",)
    assert found.probability == pytest.approx(3.0 * chi2.sf((3.5**2 + 1.5**2) / 0.99, 2))
    assert chi2.sf(off @ off / 0.99, 12) > 0.2
    assert wider(prior, found).deviation.tolist() == [1.0, 1.0, 10.0, 10.0, *np.ones(8)]
    doubted = innovation_of(0.7 * off, prior, np.diag(np.full(12, 0.01)))
    assert not doubted.is_contradicted
    assert wider(prior, doubted).deviation.tolist() == [1.0, 1.0, 3.0, 3.0, *np.ones(8)]


PAIR = rw.Pair("board", "cam_0")


def test_good_images_come_back_and_a_turned_board_does_not() -> None:
    given = cell(3, images=30, carrier=(5e-4, 2e-4))
    view = given.observations.views[PAIR]
    pixels = view.pixels.copy()
    pixels[2] = pixels[2][::-1]
    every = replace(given.observations, views={**given.observations.views, PAIR: Views(view.A, pixels)})
    kept = {rw.Pair(*at): np.ones(len(of.A), dtype=bool) for at, of in every.views.items()}
    kept[PAIR][[2, 5, 6]] = False
    some = replace(every, views={at: of.selected(kept[rw.Pair(*at)]) for at, of in every.views.items()})
    refined = rw.refine_corners(some, given.X, given.Y)
    found = agreeing_by_corners(every, kept, refined)
    assert np.flatnonzero(~found[PAIR]).tolist() == [2]
    assert all(mask.all() for pair, mask in found.items() if pair != PAIR)


def test_an_image_at_another_pose_of_the_arm_stays_out() -> None:
    """Its corners fit each other, and not the arm's pose."""
    given = cell(4, images=30, carrier=(2e-4, 1e-4))
    view = given.observations.views[PAIR]
    A = view.A.copy()
    A[3] = A[4]
    every = replace(given.observations, views={**given.observations.views, PAIR: Views(A, view.pixels)})
    kept = {rw.Pair(*at): np.ones(len(of.A), dtype=bool) for at, of in every.views.items()}
    kept[PAIR][3] = False
    some = replace(every, views={at: of.selected(kept[rw.Pair(*at)]) for at, of in every.views.items()})
    found = agreeing_by_corners(every, kept, rw.refine_corners(some, given.X, given.Y))
    assert not found[PAIR][3]


def test_calibrate_takes_them_back_too() -> None:
    given, problem = cell(3, images=30, carrier=(5e-4, 2e-4)), rw.Problem()
    for (target, sensor), view in given.observations.views.items():
        board, camera = given.observations.corners[target], given.observations.cameras[sensor]
        problem.add_corners(target, sensor, view.A, view.pixels, board, camera)
    base = rw.refine(problem, rw.solve(problem), rw.RefineOptions(noise="estimate", robust="gnc"))
    fewer = {pair: mask.copy() for pair, mask in base.inliers.items()}
    fewer[PAIR][[2, 5]] = False
    before = Answer(rw.solve(problem), fewer, replace(base, inliers=fewer))
    found = answered_by_corners(Run(problem, rw.CalibrateOptions(), silent), before)
    assert all(mask.all() for mask in found.inliers.values())
    assert found.refined is not None
    assert found.refined.reprojection is not None
    assert found.refined.reprojection.sensors["cam_0"].images == len(given.observations.views[PAIR].A)
    assert found.solution is not before.solution


def test_errors_are_those_of_the_corners_and_of_the_carriers() -> None:
    exact, noisy = (cell(3, images=30, carrier=carrier) for carrier in ((0.0, 0.0), (1e-3, 5e-4)))
    rms = []
    for given in (exact, noisy):
        refined = given.refined(seed=0)
        errors = held_out_errors(refined)
        assert set(errors) == {"cam_0", "cam_1"}
        assert sum(each.corners for each in errors.values()) >= 35 * 30 - 3
        rms.append(errors["cam_0"])
    # both axes of 0.1 pixels, and more by what the poses do not know
    assert rms[0].rms_px == pytest.approx(0.1 * np.sqrt(2.0), rel=0.15)
    # the images themselves fit to 0.1 pixels with the carriers' poses free; others are predicted by A as measured
    assert rms[1].rms_px > 3.0 * rms[0].rms_px
    assert rms[0].rms_mm == pytest.approx(1e3 * rms[0].rms_px * 1.5 / 1400.0, rel=0.4)
    assert np.nanmax(rms[0].regions_px) < 0.3


def test_stated_intrinsics_that_are_off_show() -> None:
    given = cell(4, images=30, stated_off=np.array([0.0, 0.0, 40.0, 30.0, 0.1, 0.0, 0.0, 0.0]))
    X, Y = given.near(np.random.default_rng(0))
    free = rw.CornerOptions(carrier_noise="exact")
    refined = rw.refine_corners(given.observations, X, Y, free)
    errors = held_out_errors(refined)
    assert errors["cam_0"].rms_px < 0.25


def test_what_cannot_be_left_out_is_refused() -> None:
    given = cell(0, images=5)
    refined = given.refined(seed=0)
    with pytest.raises(OptionError, match="whole number from 2"):
        held_out_errors(refined, folds=1)
    with pytest.raises(CountError, match="5 instants cannot be left out in 6 blocks"):
        held_out_errors(refined, folds=6)
