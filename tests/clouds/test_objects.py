"""Things without a pattern as targets: a robot's own clouds, and simulated ones whose truth is known."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from robot_clouds import views_of
from rwhec_factors import se3
from scipy.linalg import block_diag
from scipy.spatial.transform import Rotation

import gtsam_rwhec as rw
from gtsam_rwhec.calibration.calibrate_options import Recording
from gtsam_rwhec.clouds import Cloud, SeenObject, ViewFault, seen_object
from gtsam_rwhec.clouds.joint_registration import LOOSE, JointPoses, fitted, of_groups
from gtsam_rwhec.clouds.moved_views import move_of
from gtsam_rwhec.clouds.point_to_plane import alike, known, matches
from gtsam_rwhec.clouds.surfaces import Features, Surface, spacing_of, surface_of
from gtsam_rwhec.errors import CloudError, OutliersWarning, PoseError
from gtsam_rwhec.problem.directions import Weighing
from gtsam_rwhec.results.linear_model import LinearModel, measured_rows
from gtsam_rwhec.simulate import Noise, SimulatedClouds, clouds_of_thing
from gtsam_rwhec.simulate.simulated_clouds import Shape, seen_points, thing
from gtsam_rwhec.simulate.simulated_noise import random_poses
from gtsam_rwhec.solver.free_directions import FreeReason

#: chi-square with 6 degrees of freedom, 95 %
CHI2_95 = 12.59


def answer(
    clouds: list[Cloud], A: np.ndarray, start: np.ndarray | None = None, arm: rw.CarrierNoise | None = None
) -> tuple[rw.Calibration, np.ndarray, np.ndarray]:
    """The calibration by a thing, the sensor's pose on its carrier and its covariance."""
    problem = rw.Problem()
    seen_object(clouds, A, rw.clouds.ObjectOptions(start=start)).add_to(problem, "thing", "camera")
    stated = None if arm is None else rw.CalibrateOptions(carrier_noise=arm, noise="given")
    calibration = rw.calibrate(problem, stated)
    return calibration, calibration.refined.Y["camera"].matrix(), calibration.refined.covariance("camera")


def apart(T: np.ndarray, other: np.ndarray) -> np.ndarray:
    return se3.logmap((np.linalg.inv(T) @ other)[None])[0]


@pytest.fixture(scope="module")
def bust() -> SimulatedClouds:
    return clouds_of_thing("bust", 9, 0)


@pytest.fixture(scope="module")
def seen_bust(bust: SimulatedClouds) -> SeenObject:
    return seen_object(bust.clouds, bust.A)


def test_one_answer_by_whichever_thing(shared_data: Path) -> None:
    answers = {name: answer(*views_of(shared_data / "clouds", name)) for name in ("David", "Plane", "Sphere")}
    for calibration, _, _ in answers.values():
        assert calibration.solution.certificate.status in (rw.Status.CERTIFIED, rw.Status.CERTIFIED_NOT_UNIQUE)
        assert calibration.verdict is not rw.Verdict.DO_NOT_USE
    (_, David, of_David), (_, Plane, of_Plane), (_, Sphere, of_Sphere) = answers.values()
    of_ball = answers["Sphere"][0].refined
    assert np.isinf(np.diag(of_ball.covariance("thing"))[:3]).all()
    assert {one.reason for one in of_ball.free_directions} == {FreeReason.SLIDES}
    (alone,) = of_ball.solution.identifiability.pairs.values()
    assert {one.reason for one in alone.free_directions} == {FreeReason.SLIDES}
    of_sphere = answers["Sphere"][0]
    model = LinearModel.of(measured_rows(of_sphere.problem, of_sphere), of_sphere)
    assert np.sqrt((model.whitened()[0] ** 2).mean()) < 3.0  # what slides is no residual
    difference = apart(David, Plane)
    assert np.linalg.norm(David[:3, 3] - Plane[:3, 3]) < 1.5e-3
    assert np.degrees(np.linalg.norm(difference[:3])) < 0.35
    for covariance in (of_David, of_Plane):
        assert difference @ np.linalg.solve(covariance, difference) < CHI2_95
    # A log's problem has the same answer: there one view of nine was left out, and Plane 1.3 mm and 0.4 degrees off.
    as_log = rw.calibrate(answers["Plane"][0].problem, rw.CalibrateOptions(time_offsets=False), recording=Recording())
    assert not as_log.outliers.inliers or all(mask.all() for mask in as_log.outliers.inliers.values())
    assert (np.abs(apart(Plane, as_log.Y["camera"].matrix())) < 1e-3 * np.sqrt(np.diagonal(of_Plane))).all()
    to_David = apart(Sphere, David)
    assert to_David @ np.linalg.solve(of_Sphere + of_David, to_David) < CHI2_95


@pytest.mark.parametrize(("shape", "seed"), [("cube", 1), ("box", 0), ("heap", 203)])
def test_an_exact_arm_gives_the_sensor_to_a_tenth_of_a_millimetre(shape: Shape, seed: int) -> None:
    views = clouds_of_thing(shape, 9, seed)
    calibration, Y, covariance = answer(views.clouds, views.A)
    assert calibration.verdict is rw.Verdict.USE
    error = apart(views.T_sensorcarrier_sensor, Y)
    assert np.degrees(np.linalg.norm(error[:3])) < 0.02
    assert np.linalg.norm(Y[:3, 3] - views.T_sensorcarrier_sensor[:3, 3]) < 1e-4
    assert error @ np.linalg.solve(covariance, error) < 22.5  # 99.9 %


def test_points_that_are_nearly_exact_do_not_contradict_each_other() -> None:
    """Noise of 0.05 mm: 7 of 9 views of a cube 'contradicted the answer'."""
    seen = clouds_of_thing("cube", 9, 1, noise_m=5e-5)
    calibration, Y, covariance = answer(seen.clouds, seen.A, seen.T_sensorcarrier_sensor)
    off = apart(seen.T_sensorcarrier_sensor, Y)
    assert calibration.verdict is rw.Verdict.USE
    assert off @ np.linalg.solve(covariance, off) < CHI2_95


def test_arrays_of_points_are_clouds_and_other_things_are_named(bust: SimulatedClouds, seen_bust: SeenObject) -> None:
    plain = seen_object([each.points for each in bust.clouds], bust.A)
    assert np.array_equal(plain.T_sensor_object, seen_bust.T_sensor_object)
    with pytest.raises(CloudError, match=r"clouds\[1\]: points cannot be read as numbers"):
        seen_object([bust.clouds[0], "two.pcd"], bust.A[:2])  # type: ignore[list-item]
    with pytest.raises(CloudError, match="clouds are 'folder'; give a list of Cloud"):
        seen_object("folder", bust.A)  # type: ignore[arg-type]


def test_clouds_of_another_scale_than_the_poses_are_named(bust: SimulatedClouds) -> None:
    longer = [replace(each, points=1.005 * each.points) for each in bust.clouds]
    calibration, _, _ = answer(longer, bust.A, bust.T_sensorcarrier_sensor)
    assert rw.Ground.SIZE_DOUBTED in calibration.judgement.grounds
    assert "lengths in the clouds of thing are 0.5 % larger than the motion says" in str(calibration.judgement)


def test_a_depth_camera_whose_focal_length_is_wrong_is_named(bust: SimulatedClouds) -> None:
    """Clouds 1 % too long across the camera's axis were 'use' with the sensor 3 mm off; overall scale is right."""
    wide = [replace(each, points=each.points * [1.01, 1.01, 1.0]) for each in bust.clouds]
    problem = rw.Problem()
    options = rw.clouds.ObjectOptions(start=bust.T_sensorcarrier_sensor)
    seen_object(wide, bust.A, options).add_to(problem, "bust", "camera")
    calibration = rw.calibrate(problem)
    assert rw.Ground.CLOUDS_STRETCHED in calibration.judgement.grounds
    assert calibration.verdict is rw.Verdict.CARE
    (words,) = [each.words for each in calibration.findings if each.ground is rw.Ground.CLOUDS_STRETCHED]
    assert re.match(r"the clouds of camera are (0\.8|0\.9|1).* % longer across its z axis than along it", words)
    assert (problem + rw.Problem()).stretched == problem.stretched


RIGHT = (("relief", 1e-4), ("sphere", 1e-4), ("cylinder", 2e-4), ("sphere", 1e-3))


@pytest.mark.parametrize(("shape", "noise_m"), RIGHT)
def test_right_clouds_are_not_stretched(shape: Shape, noise_m: float) -> None:
    """Reliefs were accused by residuals over the radius, and round things that were smoothed by this test: 0.8 %."""
    views = clouds_of_thing(shape, 6, 81, noise_m=noise_m)
    options = rw.clouds.ObjectOptions(start=views.T_sensorcarrier_sensor)
    found = seen_object(views.clouds, views.A, options).stretch_of("camera")
    assert not found.is_clear
    assert np.isinf(found.sigma) == (noise_m == 1e-3)


def test_lengths_in_clouds_are_estimated_only_if_asked_for() -> None:
    """By the command, a first fit without noise of A made right clouds of a box 1 % longer, without a word."""
    made = clouds_of_thing("box", 12, 7, noise_in_A=Noise(sigma_m=3e-4, kappa=0.5 / np.radians(0.1) ** 2))
    problem = rw.Problem()
    seen_object(made.clouds, made.A).add_to(problem, "thing", "camera")
    scales = [
        rw.calibrate(problem, rw.CalibrateOptions(sizes=sizes, time_offsets=False), recording=Recording()).scale
        for sizes in ("correct", "estimate")
    ]
    assert scales[0] == 1.0 != scales[1]


def test_groups_of_views_that_little_links_claim_no_more_than_all_views_together() -> None:
    rng = np.random.default_rng(4)
    poses = random_poses(6, 0.3, rng)
    i, j = np.triu_indices(6, 1)
    across = (i < 3) != (j < 3)  # three views of one side, three of the other, and edges between them
    information = np.tile(np.diag(np.r_[1e6, 1e6, 1e6, 1e8, 1e8, 1e8]), (len(i), 1, 1))
    information[across] *= 1e-4
    groups = of_groups(poses, i, j, information, np.tile(np.eye(6), (6, 1, 1)))
    J = np.zeros((len(i), 6, 36))
    for k, (a, b) in enumerate(zip(i, j, strict=True)):
        J[k, :, 6 * b : 6 * b + 6] = np.eye(6)
        J[k, :, 6 * a : 6 * a + 6] = -se3.adjoint((se3.inverse(poses[b]) @ poses[a])[None])[0]
    whole = np.einsum("kia,kij,kjb->ab", J, information, J)
    anywhere = se3.adjoint(se3.inverse(poses)).reshape(36, 6)
    assert np.abs(whole @ anywhere).max() < 1e-6 * np.abs(whole).max()
    alone = [np.linalg.inv(whole[6 * k : 6 * k + 6, 6 * k : 6 * k + 6]) for k in range(6)]
    joint = JointPoses(poses, np.array(alone), groups, np.ones(2), 0.0)
    claimed = block_diag(*((LOOSE - 1.0) * each + whole for each, whole in zip(alone, joint.covariances, strict=True)))
    # In what the thing's own free pose leaves, no direction is claimed better than it is.
    seen = np.linalg.svd(np.linalg.solve(claimed, anywhere))[0][:, 6:]
    covariance = seen @ np.linalg.inv(seen.T @ whole @ seen) @ seen.T
    assert np.linalg.eigvalsh(seen.T @ (claimed - covariance) @ seen).min() > -1e-12
    assert max(np.trace(each[3:, 3:]) for each in joint.covariances) > 10.0 * max(
        np.trace(each[3:, 3:]) for each in alone
    )


def test_errors_of_groups_are_fitted_as_one_estimate_of_all_has_them() -> None:
    rng = np.random.default_rng(5)
    N, scale = 8, np.repeat([2e-4, 1e-4], 3)
    X, Y, A = random_poses(1, 0.5, rng)[0], random_poses(1, 0.2, rng)[0], random_poses(N, 0.5, rng)
    truth = se3.inverse(Y) @ A @ X
    covariances = np.tile(np.diag(scale**2), (N, 1, 1))
    groups = 5.0 * scale[:, None] * rng.normal(size=(N, 6, 3))
    of_A = np.repeat([3e-4, 2e-4], 3) ** 2
    n, b, z = (size * rng.normal(size=(N, 6)) for size in (np.sqrt(of_A), scale, 1.0))
    frames = se3.inverse(A) @ Y  # A is off in those of the target carrier
    B = se3.inverse(frames) @ se3.expmap(-n) @ frames @ truth @ se3.expmap(-(groups @ z[0, :3] + b))
    B_fitted, moves = fitted(A, B, covariances, groups, of_A, frames, Y)
    assert np.abs(se3.logmap(se3.inverse(B_fitted) @ truth)).max() < np.abs(se3.logmap(se3.inverse(B) @ truth)).max()

    # One system of all residuals with their whole covariance, in which errors of groups are correlated noise.
    def answer(of: np.ndarray, modes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        back = se3.adjoint(se3.inverse(of))
        J = np.concatenate([-back, np.tile(np.eye(6), (N, 1, 1))], axis=2).reshape(6 * N, 12)
        of_n = se3.adjoint(se3.inverse(frames @ of))
        single = block_diag(*(covariances + of_n * of_A @ of_n.transpose(0, 2, 1)))
        W = np.linalg.inv(single + modes @ modes.T)
        residual = se3.logmap(se3.inverse(of) @ truth).ravel()
        known = np.linalg.inv(J.T @ W @ J)
        return -(known @ J.T @ W @ residual)[:6], known[:6, :6]

    step, covariance = answer(B, groups.reshape(6 * N, 3))
    step_fitted, covariance_fitted = answer(B_fitted, np.zeros((6 * N, 1)))
    assert np.abs(step - step_fitted).max() < 0.02 * np.sqrt(np.diagonal(covariance)).max()
    assert np.allclose(covariance_fitted + moves @ moves.T, covariance, rtol=0.02, atol=1e-3 * covariance.max())


@pytest.mark.parametrize(("shape", "slides"), [("sphere", 3), ("cylinder", 2)])
def test_what_slides_has_no_weight(shape: str, slides: int) -> None:
    views = clouds_of_thing(shape, 6, 2)
    seen = seen_object(views.clouds, views.A)
    unknown = np.linalg.eigvalsh(seen.covariances[seen.used]) > 1e-2**2
    assert (unknown.sum(axis=1) == slides).all()
    if shape == "sphere":  # its centre is known although its turn is not: the frame is in the centre
        problem = rw.Problem()
        seen.add_to(problem, "sphere", "camera")
        weighing = Weighing.of(problem.measurements("sphere", "camera"))
        assert np.linalg.norm(weighing.centre, axis=1).max() < 1e-3
        assert 1.0 / np.sqrt(weighing.of_axes.min()) < 1e-3


def test_the_information_of_a_pair_is_what_repeated_noise_shows() -> None:
    views = clouds_of_thing("relief", 3, 3)
    distance = thing("relief", np.random.default_rng(3).spawn(5)[0])
    errors, expected = [], []
    for draw in range(6):
        clouds = [
            Cloud.of(seen_points(distance, T, 1e-4, 100 * draw + k))
            for k, T in enumerate(se3.inverse(views.T_sensor_object))
        ]
        pairs = rw.clouds.motions(clouds, views.A, rw.clouds.ObjectOptions(start=views.T_sensorcarrier_sensor))
        truth = views.T_sensor_object[pairs.i] @ se3.inverse(views.T_sensor_object[pairs.j])
        error = se3.logmap(se3.inverse(truth) @ pairs.B)
        errors.append(np.einsum("ni,nij,nj->n", error, np.linalg.inv(pairs.covariances), error).mean())
        expected.append(6.0)
    assert 0.2 < np.sum(errors) / np.sum(expected) < 2.0


def test_points_with_noise_as_large_as_their_distance_are_smoothed_along_their_rays() -> None:
    """3 mm of noise on a thing of 12 cm moved the sensor by 3 mm where 1 mm was claimed."""
    seen = clouds_of_thing("bust", 12, 100, noise_m=3e-3)
    calibration, Y, covariance = answer(seen.clouds, seen.A, seen.T_sensorcarrier_sensor)
    off = apart(seen.T_sensorcarrier_sensor, Y)
    assert calibration.verdict is rw.Verdict.USE
    assert np.linalg.norm(off[3:]) < 1e-3
    assert off @ np.linalg.solve(covariance, off) < CHI2_95
    noise = [spacing_of([cloud.points], 12).noise_m for cloud in seen.clouds[:3]]
    np.testing.assert_allclose(noise, 3e-3, rtol=0.1)
    assert not spacing_of([clouds_of_thing("bust", 1, 100).clouds[0].points], 12).is_noisy


def test_the_pattern_of_a_sensor_that_all_views_share_is_in_the_ellipsoid() -> None:
    """Half a millimetre that follows the image: 1.3 mm and 0.24 degrees off where 0.3 mm were claimed."""
    seen = clouds_of_thing("heap", 12, 300)
    draw = np.random.default_rng(1)
    waves, phases = draw.normal(0.0, 40.0, (12, 2)), draw.uniform(0.0, 6.28, 12)
    clouds = []
    for cloud in seen.clouds:
        off = 5e-4 * np.sin(cloud.points[:, :2] / cloud.points[:, 2:] @ waves.T + phases).sum(axis=1) / np.sqrt(6.0)
        clouds.append(Cloud.of(cloud.points * (1.0 + off / np.linalg.norm(cloud.points, axis=1))[:, None]))
    _, Y, covariance = answer(clouds, seen.A, seen.T_sensorcarrier_sensor)
    off = apart(seen.T_sensorcarrier_sensor, Y)
    assert off @ np.linalg.solve(covariance, off) < CHI2_95
    assert alike(1.4e-4, 1e-4) == 0.0  # what noise along rays explains is no pattern


#: Of the arm, about and along each axis.
ARM = rw.CarrierNoise(rotation_rad=np.radians(0.1), translation_m=3e-4)
NOISE_OF_ARM = Noise(sigma_m=ARM.translation_m, kappa=0.5 / ARM.rotation_rad**2)


def test_noise_of_the_arm_is_in_the_ellipsoid() -> None:
    views = clouds_of_thing("heap", 9, 4, noise_in_A=NOISE_OF_ARM)
    _, Y, covariance = answer(views.clouds, views.A, views.T_sensorcarrier_sensor)
    error = apart(views.T_sensorcarrier_sensor, Y)
    assert error @ np.linalg.solve(covariance, error) < 22.5  # 99.9 %


@pytest.mark.parametrize(("shape", "seed", "noise_m"), [("box", 4065, 1e-4), ("cube", 5000, 1e-6)])
def test_views_are_placed_by_what_they_tell_and_not_by_the_noise_of_the_arm(
    shape: Shape, seed: int, noise_m: float
) -> None:
    """Turns of the base, 0.8 m away, looked like shifts of the sensor (chi2 25, 0.9 mm off). Without noise, as of
    simulators, points that tell a pose had no weight (chi2 94, USE, 2.2 mm off)."""
    views = clouds_of_thing(shape, 20, seed, noise_m=noise_m, noise_in_A=NOISE_OF_ARM)
    _, Y, covariance = answer(views.clouds, views.A, arm=ARM)
    error = apart(views.T_sensorcarrier_sensor, Y)
    assert error @ np.linalg.solve(covariance, error) < CHI2_95


def test_a_thing_on_the_hand_before_a_still_camera_is_the_same(bust: SimulatedClouds, seen_bust: SeenObject) -> None:
    """A fixed camera's carrier is the base and the thing's the hand: A = T_base_hand has the same form."""
    assert np.linalg.eigvalsh(seen_bust.covariances).max() < 1e-2**2  # and nothing slides
    shift = se3.pose(Rotation.from_euler("xyz", [0.4, -1.0, 2.0]).as_matrix(), [0.3, -0.2, 0.9])
    turned = seen_object(bust.clouds, shift @ bust.A)
    moved = np.linalg.inv(shift @ bust.T_sensorcarrier_sensor) @ turned.T_sensorcarrier_sensor
    still = np.linalg.inv(bust.T_sensorcarrier_sensor) @ seen_bust.T_sensorcarrier_sensor
    assert np.abs(moved - still).max() < 1e-3


def test_a_view_in_which_the_thing_was_elsewhere_is_left_out(bust: SimulatedClouds) -> None:
    A = bust.A.copy()
    A[4] = A[4] @ se3.pose(np.eye(3), [0.012, 0.0, 0.005])
    seen = seen_object(bust.clouds, A)
    assert list(seen.left_out) == [4]
    assert seen.left_out[4].fault is ViewFault.MOVED
    assert seen.left_out[4].off_m == pytest.approx(0.013, abs=0.001)
    assert np.isnan(seen.T_sensor_object[4]).all()
    assert not seen.used[4]
    first, _, left_out = str(seen).splitlines()
    assert first.startswith("A thing in 8 of 9 views, by ")
    assert left_out.startswith("  left out: bust 4 shows the thing 13.")
    with pytest.warns(OutliersWarning, match=r"^1 of 9 views of bust are left out: bust 4 shows the thing 13\."):
        seen.add_to(rw.Problem(), "bust", "camera")


def test_a_thing_that_moved_and_stayed_is_an_error(bust: SimulatedClouds) -> None:
    A = bust.A.copy()
    A[5:] = A[5:] @ se3.pose(np.eye(3), [0.010, 0.0, 0.010])
    with pytest.raises(CloudError, match=r"the thing moved by 1\d\.\d mm before bust 5, and stayed"):
        seen_object(bust.clouds, A)


def test_a_cylinder_that_slides_along_itself_did_not_move() -> None:
    """Noise of its axis in each view made moves along it, of 25 to 1,400 mm, in 24 of 1,000 draws of an arm's noise."""
    seen, rng = clouds_of_thing("cylinder", 20, 5), np.random.default_rng(1)
    poses = se3.inverse(seen.T_sensor_object)
    unit = np.diag([1.0 / 0.06] * 3 + [1.0] * 3)
    axes = np.tile(np.eye(6)[[1, 4]].T, (20, 1, 1)) + rng.normal(0.0, 2e-3, (20, 6, 2))
    slides = np.linalg.qr(unit @ se3.adjoint(seen.T_sensor_object) @ axes)[0]
    free = 100.0 * slides @ slides.transpose(0, 2, 1)
    covariances = unit @ (1e-8 * np.eye(6) + free) @ unit
    lever = se3.pose(np.eye(3), [0.5, 0.4, 0.4])
    found = []
    for _ in range(60):
        of_arm = se3.expmap(rng.normal(size=(20, 6)) * np.repeat([np.radians(0.1), 3e-4], 3))
        predicted = lever @ of_arm @ np.linalg.inv(lever) @ poses
        found.append(move_of(poses, predicted, covariances, np.tile(unit, (20, 1, 1)), 0.06))
    assert found == [None] * 60


def test_one_point_that_matches_tells_nothing() -> None:
    far, z = np.array([[9.0, 9.0, 9.0]]), np.array([[0.0, 0.0, 1.0]])
    one = Surface("one", Features(np.zeros((1, 3)), z), Features(far, z), None, None)
    found = matches(one, one, np.eye(4), 0.01)
    tell = known(
        replace(
            found,
            kind=found.kind[:1],
            **{name: getattr(found, name)[:1] for name in ("points", "residuals", "rows", "own_rows", "at")},
        ),
        np.array([1e-4, 1e-4]),
    )
    assert np.isfinite(tell.covariance).all()
    assert (np.linalg.eigvalsh(tell.covariance) > 1.0).all()


def test_poses_that_explain_nothing_are_named(bust: SimulatedClouds) -> None:
    clouds = [cloud.selected(np.arange(0, len(cloud), 3)) for cloud in bust.clouds[:5]]
    poses = bust.A[:5]
    for A, words in (
        (np.roll(poses[:4], 1, axis=0), "with A shifted by minus one row the clouds fit"),
        (se3.pose(poses[:4, :3, :3], 1e3 * poses[:4, :3, 3]), "like m beside mm: .* A's translations by 0.001"),
        (se3.pose(poses[:4, :3, :3], 0.1 * poses[:4, :3, 3]), "like 0.1 mm beside mm: .* unit_m .* by 0.1"),
        (se3.inverse(poses), "A is inverted"),
        (np.random.default_rng(0).permutation(poses[:4]), "do the clouds overlap"),
    ):
        with pytest.raises(CloudError, match=words):
            seen_object(clouds[: len(A)], A)


def test_a_second_sensor_gives_the_thing_a_frame_of_its_own(seen_bust: SeenObject) -> None:
    """As one target two sensors were 3.5 mm off with 'use', since their frames of the thing differ."""
    problem = rw.Problem()
    seen_bust.add_to(problem, "thing", "left")
    with pytest.raises(CloudError, match="give the thing another; add it as a target of its own, such as thing_right"):
        seen_bust.add_to(problem, "thing", "right")
    seen_bust.add_to(problem, "thing_right", "right")
    assert [pair.target for pair in problem.pairs] == ["thing", "thing_right"]


def test_a_wall_that_does_not_move_before_the_sensor_is_named(bust: SimulatedClouds) -> None:
    draw = np.random.default_rng(5)
    wall = np.column_stack([draw.uniform(-0.25, 0.25, (1000, 2)), draw.normal(0.6, 1e-4, 1000)])
    clouds = [Cloud.of(np.vstack([cloud.points[::3], wall])) for cloud in bust.clouds[:4]]
    with pytest.raises(CloudError, match="does not move before the sensor"):
        seen_object(clouds, bust.A[:4])


def test_poses_or_clouds_that_are_all_the_same_are_named(bust: SimulatedClouds) -> None:
    with pytest.raises(CloudError, match="all 9 poses are the same"):
        seen_object(bust.clouds, np.repeat(bust.A[:1], 9, axis=0))
    with pytest.raises(CloudError, match="all 6 clouds are the same"):
        seen_object([bust.clouds[0]] * 6, bust.A[:6])


def test_points_far_beyond_all_others_change_nothing(bust: SimulatedClouds, capfd: pytest.CaptureFixture[str]) -> None:
    points = bust.clouds[2].points
    far = np.vstack([points, [[1e20, 0.0, 0.0], [3e7, 1.0, 1.0]]])
    spacing = spacing_of([far], 9)
    found, plain = (surface_of(Cloud.of(each), "view", spacing) for each in (far, points))
    np.testing.assert_array_equal(found.faces.points, plain.faces.points)
    assert capfd.readouterr().err == ""  # the library for registrations writes there


def test_a_thing_before_an_endless_wall_is_not_refused() -> None:
    """The wall stands still as the thing does, and each view shows another part of it: it was "no overlap"."""
    seen, draw, half = clouds_of_thing("bust", 9, 2), np.random.default_rng(2), np.tan(np.radians(15.0))
    side = half * np.linspace(-1.0, 1.0, 110)
    rays = np.stack([*np.meshgrid(side, side), np.ones((110, 110))], axis=-1).reshape(-1, 3)
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    clouds = []
    for cloud, T_sensor_object in zip(seen.clouds, seen.T_sensor_object, strict=True):
        normal = T_sensor_object[:3, 2]
        lengths = normal @ (T_sensor_object @ [0.0, 0.0, -0.1, 1.0])[:3] / (rays @ normal)
        column, row = np.round((cloud.points[:, :2] / cloud.points[:, 2:] / half + 1.0) * 54.5).astype(int).T
        free = lengths > 0.0
        free[110 * row + column] = False
        wall = rays[free] * (lengths[free] + draw.normal(0.0, 1e-4, free.sum()))[:, None]
        clouds.append(Cloud.of(np.vstack([cloud.points, wall])))
    found = seen_object(clouds, seen.A)
    assert np.abs(apart(seen.T_sensorcarrier_sensor, found.T_sensorcarrier_sensor)).max() < 3e-4


def test_what_is_too_little_is_said(bust: SimulatedClouds) -> None:
    with pytest.raises(CloudError, match="2 views have 50 points and more; at least 3"):
        seen_object(bust.clouds[:2], bust.A[:2])
    with pytest.raises(CloudError, match="9 clouds and 8 poses in A"):
        seen_object(bust.clouds, bust.A[:8])
    with pytest.raises(CloudError, match="0 views have"):
        seen_object([], np.empty((0, 4, 4)))
    broken = bust.A.copy()
    broken[3, 0, 0] = np.nan
    with pytest.raises(PoseError, match="measurement 3"):
        seen_object(bust.clouds, broken)


def test_a_view_in_another_unit_and_one_cloud_of_two_poses_are_left_out(bust: SimulatedClouds) -> None:
    """One cloud of nine in millimetres: "at no pose do the clouds overlap"."""
    clouds = list(bust.clouds)
    clouds[2] = replace(clouds[2], points=1e3 * clouds[2].points)
    clouds[3] = replace(clouds[3], points=clouds[3].points / 0.0254)
    clouds[6] = Cloud.of(np.random.default_rng(0).permutation(clouds[4].points.astype(np.float32)))
    seen = seen_object(clouds, bust.A)
    mm, inches, one, other = map(str, seen.left_out.values())
    assert re.match(r"bust 2 shows a thing of \d\d m, \d+ times .* like mm beside m: .* its points by 0.001 ", mm)
    assert re.match(r"bust 3 shows a thing of .* like inches beside m: multiply its points by 0.0254 ", inches)
    assert one == "bust 4 has the same points as clouds[6]: one cloud is stored twice, and has one pose only"
    assert other.startswith("clouds[6] has the same points as bust 4")
    again = seen_object([*bust.clouds[:6], bust.clouds[4]], bust.A[[0, 1, 2, 3, 4, 5, 4]])
    assert list(again.left_out) == [6]  # the first counts where the pose is the same


def test_views_of_other_things_and_of_few_points_are_left_out(bust: SimulatedClouds) -> None:
    clouds = list(bust.clouds)
    clouds[2] = clouds_of_thing("bust", 3, 77).clouds[0]
    clouds[6] = Cloud.of(clouds[6].points[:30])
    seen = seen_object(clouds, bust.A)
    assert {view: finding.fault for view, finding in seen.left_out.items()} == {
        2: ViewFault.APART,
        6: ViewFault.FEW_POINTS,
    }
