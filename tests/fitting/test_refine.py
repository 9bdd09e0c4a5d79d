"""refine: against the certified solution, against the truth, and against equivalent problems."""

from __future__ import annotations

import warnings

import gtsam
import numpy as np
import pytest
from refinement_problems import KAPPA, SIGMA_M, SIGMA_RAD, copied, distance, refined, rig
from rwhec_factors import se3

import gtsam_rwhec as rw
from gtsam_rwhec.fitting.refinement_from_poses import refine as refine_poses
from gtsam_rwhec.simulate import Noise, general, perturb


@pytest.mark.parametrize("scale", ["known", "shared"])
def test_chordal_optimum_is_the_certified_one(scale: str) -> None:
    simulation = rig(3, 2, scale=scale)
    solution = rw.solve(simulation.problem)
    r = rw.refine(simulation.problem, solution, rw.RefineOptions(residual="chordal"))
    assert distance(r, solution) < 1e-8
    assert r.cost == pytest.approx(solution.cost, rel=1e-9)
    assert r.initial_cost == pytest.approx(r.cost, rel=1e-9)
    assert all(moved.translation_mm < 1e-4 for moved in r.moved.values())
    np.testing.assert_allclose(r.scale, solution.scale, rtol=1e-9)


def test_chordal_needs_no_measurements() -> None:
    kept, left = rig(seed=1), rig(seed=1, keep_measurements=False)
    options = rw.RefineOptions(residual="chordal")
    first = rw.refine(kept.problem, rw.solve(kept.problem), options)
    second = rw.refine(left.problem, rw.solve(left.problem), options)
    np.testing.assert_allclose(first.covariance(), second.covariance(), rtol=1e-9)


def test_both_residuals_agree_to_first_order() -> None:
    simulation = rig(noise=Noise(0.001, 0.5 / np.radians(0.1) ** 2))
    chordal, geodesic = (refined(simulation.problem, residual=r) for r in ("chordal", "geodesic"))
    assert distance(chordal, geodesic) < 1e-4
    np.testing.assert_allclose(
        chordal.covariance() / np.sqrt(np.outer(*[np.diag(chordal.covariance())] * 2)),
        geodesic.covariance() / np.sqrt(np.outer(*[np.diag(geodesic.covariance())] * 2)),
        atol=0.01,
    )


@pytest.mark.parametrize("residual", ["chordal", "geodesic"])
def test_covariance_is_gtsams_marginal(residual: str) -> None:
    """Without free directions the covariances are GTSAM's."""
    r = refined(rig(scale="shared").problem, residual=residual)
    marginals = gtsam.Marginals(r.graph, r.values)
    for name in ("target1", "sensor0", "scale"):
        np.testing.assert_allclose(r.covariance(name), marginals.marginalCovariance(r.keys[name]), rtol=1e-6)
    # GTSAM sorts joint marginals by key; symbols "s" < "x" < "y".
    joint = marginals.jointMarginalCovariance([r.keys["scale"], r.keys["target0"]]).fullMatrix()
    np.testing.assert_allclose(r.covariance("scale", "target0"), joint, rtol=1e-6, atol=1e-15)


def test_joint_covariance_has_the_order_asked_for() -> None:
    r = refined(rig().problem)
    there, back = r.covariance("sensor0", "target1"), r.covariance("target1", "sensor0")
    assert there.shape == (12, 12)
    np.testing.assert_array_equal(there[:6, 6:], back[6:, :6])
    np.testing.assert_array_equal(there[:6, :6], r.covariance("sensor0"))
    assert r.covariance().shape == (24, 24)


def test_relative_pose_and_its_covariance() -> None:
    r = refined(rig(2, 3, seed=4).problem)
    pose, covariance = r.relative("sensor0", "sensor2")
    assert pose.equals(r.Y["sensor0"].inverse().compose(r.Y["sensor2"]), 1e-12)
    joint = r.covariance("sensor0", "sensor2")
    J = rw.pose_covariances.relative_jacobian(r.Y["sensor0"], r.Y["sensor2"])
    np.testing.assert_allclose(covariance, J @ joint @ J.T, rtol=1e-8, atol=1e-16)
    back, of_back = r.relative("sensor2", "sensor0")
    np.testing.assert_allclose(of_back, rw.pose_covariances.of_inverse(pose, covariance), rtol=1e-8, atol=1e-15)
    assert back.equals(pose.inverse(), 1e-12)
    with pytest.raises(rw.errors.FrameError, match="two carriers"):
        r.relative("sensor0", "target0")
    with pytest.raises(rw.errors.FrameError, match="no 'sensor9'"):
        r.relative("sensor0", "sensor9")
    with pytest.raises(rw.errors.FrameError, match="itself"):
        r.relative("sensor0", "sensor0")


def test_the_order_of_samples_does_not_matter() -> None:
    problem = copied(rig(seed=6).problem, stamps_ns=lambda pair, raw: None)  # stamps must not go back
    turned = copied(problem, A=lambda pair, raw: raw.A[::-1], B=lambda pair, raw: raw.B[::-1])
    first, second = refined(problem, noise="estimate"), refined(turned, noise="estimate")
    assert distance(first, second) < 1e-9
    np.testing.assert_allclose(first.covariance(), second.covariance(), rtol=1e-6, atol=1e-14)


@pytest.mark.parametrize("residual", ["chordal", "geodesic"])
def test_estimated_noise_does_not_depend_on_what_was_given(residual: str) -> None:
    problem = rig(seed=7).problem
    wrong = copied(problem, sigma=lambda pair, raw: 7.0 * raw.sigma, kappa=lambda pair, raw: 0.01 * raw.kappa)
    unit = rw.Problem()
    for pair in problem.pairs:
        raw = problem.measurements(*pair)
        unit.add(*pair, raw.A, raw.B)
    results = [refined(p, noise="estimate", residual=residual) for p in (problem, wrong)]
    results.append(refined(unit, residual=residual))  # "auto" estimates where nothing was given
    assert [r.noise_source for r in results] == ["estimated"] * 3
    for r in results:
        np.testing.assert_allclose(r.covariance(), results[0].covariance(), rtol=2e-3, atol=1e-11)
        noise = next(iter(r.noise.values()))
        assert noise.rotation_rad == pytest.approx(SIGMA_RAD, rel=0.15)
        assert noise.translation_m == pytest.approx(SIGMA_M, rel=0.15)
        assert sum(noise.degrees_of_freedom) == pytest.approx(6 * 80 - 24, abs=0.5)


@pytest.mark.parametrize("residual", ["chordal", "geodesic"])
def test_the_noise_of_a_near_answer_is_a_start(residual: str) -> None:
    problem = copied(rig(seed=7).problem, kappa=lambda pair, raw: 0.01 * raw.kappa)
    solution, options = rw.solve(problem), rw.RefineOptions(noise="estimate", residual=residual)
    near = refine_poses(problem, solution, options)
    again = refine_poses(problem, solution, options, near=near)
    assert again.iterations < near.iterations
    np.testing.assert_allclose(again.covariance(), near.covariance(), rtol=1e-3, atol=1e-11)


def test_noise_by_sensor_and_by_pair() -> None:
    noises = {
        (f"target{j}", f"sensor{k}"): Noise(0.002 if k else 0.02, 0.5 / np.radians(0.2 if k else 2.0) ** 2)
        for j in range(2)
        for k in range(2)
    }
    exact = general(2, 2, seed=8, noise=noises, number_of_measurements=100)
    flat = copied(exact.problem, sigma=lambda p, raw: 0.01 + 0 * raw.sigma, kappa=lambda p, raw: 1000.0 + 0 * raw.kappa)
    for groups in ("sensor", "pair"):
        r = refined(flat, noise="estimate", noise_groups=groups)
        for pair, noise in noises.items():
            assert r.noise[pair].translation_m == pytest.approx(noise.sigma_m, rel=0.15)
            assert r.noise[pair].rotation_rad == pytest.approx(np.sqrt(0.5 / noise.kappa), rel=0.15)
    one = refined(flat, noise="estimate")
    assert len({noise.translation_m for noise in one.noise.values()}) == 1


def test_full_covariances_are_honoured() -> None:
    """Noise of B along its x only: full covariances lower the error, and the covariance shows by how much."""
    exact = general(1, 1, seed=9, number_of_measurements=60)
    sigma = np.r_[np.full(3, np.radians(0.1)), 0.05, 0.001, 0.001]
    squares: dict[str, list[float]] = {"whole": [], "mean": []}
    raw = exact.problem.measurements("target0", "sensor0")
    for seed in range(12):
        xi = np.random.default_rng(seed).normal(size=(60, 6)) * sigma
        B = [gtsam.Pose3(b).retract(x) for b, x in zip(raw.B, xi, strict=True)]
        whole, mean = rw.Problem(), rw.Problem()
        whole.add("target0", "sensor0", raw.A, B, covariances=np.diag(sigma**2))
        mean.add("target0", "sensor0", raw.A, B, np.sqrt(np.mean(sigma[3:] ** 2)), 0.5 / sigma[0] ** 2)
        for name, problem in (("whole", whole), ("mean", mean)):
            r = refined(problem)
            error = rw.pose_covariances.error_of(r.Y["sensor0"], exact.Y["sensor0"])
            squares[name].append(float(error[3:] @ error[3:]))
            if name == "whole":
                assert r.contains("sensor0", exact.Y["sensor0"], 0.9999)
    assert np.mean(squares["whole"]) < 0.05 * np.mean(squares["mean"])
    with pytest.raises(rw.errors.OptionError, match="full covariances, which the chordal residual cannot hold"):
        refined(whole, residual="chordal")


@pytest.mark.parametrize("residual", ["chordal", "geodesic"])
def test_planar_motion_has_infinite_variance_along_what_is_free(residual: str) -> None:
    simulation = rig(1, 2, seed=2, motion="planar", number_of_measurements=40)
    solution = None
    with pytest.warns(rw.errors.NotUniqueWarning):
        solution = rw.solve(simulation.problem)
    with pytest.warns(rw.errors.NotUniqueWarning, match="variances are infinite: .*translation of .* along"):
        r = rw.refine(simulation.problem, solution, rw.RefineOptions(residual=residual))
    assert r.free_directions
    assert np.isinf(np.diag(r.covariance("target0"))).any()
    # The world's z is free for all together: the target along the plane's normal, in its own axes.
    information = r.information("target0")
    normal = r.X["target0"].rotation().matrix().T @ np.array([0.0, 0.0, 1.0])
    assert np.abs(information[3:, 3:] @ normal).max() < 0.02 * np.abs(information[3:, 3:]).max()
    # Sensor to sensor nothing is free: both move along together.
    _, covariance = r.relative("sensor0", "sensor1")
    assert np.isfinite(covariance).all()
    assert np.sqrt(np.diag(covariance)).max() < 0.1
    assert r.contains("target0", simulation.X["target0"], 0.999)


def test_a_prior_makes_the_free_direction_finite() -> None:
    simulation = rig(1, 1, seed=2, motion="planar", number_of_measurements=40)
    simulation.problem.add_prior("target0", simulation.X["target0"], sigma=0.01)
    for residual in ("chordal", "geodesic"):
        with warnings.catch_warnings(action="error", category=rw.errors.NotUniqueWarning):
            r = rw.refine(simulation.problem, rw.solve(simulation.problem), rw.RefineOptions(residual=residual))
        deviations = r.standard_deviations("target0")[1]
        assert deviations.max() < 10.1  # no wider than the prior, in mm
        assert r.contains("target0", simulation.X["target0"], 0.999)


@pytest.mark.parametrize("scale", ["known", "shared"])
def test_map_estimate_with_priors_is_the_certified_one(scale: str) -> None:
    simulation = rig(2, 2, seed=5, scale=scale)
    off = gtsam.Pose3(simulation.X["target0"]).retract(np.r_[0.02, -0.01, 0.0, 0.01, 0.0, 0.02])
    simulation.problem.add_prior("target0", off, kappa=1000.0, sigma=0.02 if scale == "known" else None)
    solution = rw.solve(simulation.problem)
    r = rw.refine(simulation.problem, solution, rw.RefineOptions(residual="chordal"))
    assert distance(r, solution) < 1e-7
    assert r.cost == pytest.approx(solution.cost, rel=1e-8)


def test_fixed_frames_stay_and_have_no_variance() -> None:
    simulation = rig(2, 2, seed=5)
    simulation.problem.fix("sensor0", simulation.Y["sensor0"])
    for residual in ("chordal", "geodesic"):
        r = refined(simulation.problem, residual=residual)
        np.testing.assert_allclose(r.Y["sensor0"].matrix(), simulation.Y["sensor0"], atol=1e-9)
        np.testing.assert_array_equal(r.covariance("sensor0"), np.zeros((6, 6)))
        assert "sensor0" not in r.names
        pose, covariance = r.relative("sensor0", "sensor1")
        np.testing.assert_allclose(covariance, r.covariance("sensor1"), rtol=1e-9)
        assert pose.equals(r.Y["sensor0"].between(r.Y["sensor1"]), 1e-12)
        assert r.contains("sensor0", simulation.Y["sensor0"])


@pytest.mark.parametrize("residual", ["geodesic", "chordal"])
def test_per_target_scales_under_the_exact_model(residual: str) -> None:
    """The certified form's scale is 5 % off at 5 degrees of noise; refined it is where its variance says (fact 7)."""
    certified, scores = [], []
    for seed in range(8):
        simulation = rig(
            2,
            2,
            seed=seed,
            scale="per_target",
            known_sizes=("target1",),
            noise=Noise(0.01, 0.5 / np.radians(5.0) ** 2),
            number_of_measurements=30,
        )
        with warnings.catch_warnings(action="ignore", category=rw.errors.RwhecWarning):
            solution = rw.solve(simulation.problem)
            r = rw.refine(simulation.problem, solution, rw.RefineOptions(residual=residual))
        truth = simulation.scale["target0"]
        assert r.scale["target1"] == 1.0
        certified.append(solution.scale["target0"] / truth - 1.0)
        scores.append((r.scale["target0"] - truth) / np.sqrt(r.covariance("scale:target0")[0, 0]))
    assert np.mean(np.abs(certified)) > 0.02
    assert 0.4 < np.mean(np.square(scores)) < 2.5  # a chi-square of 8 degrees of freedom, over 8


def test_motions_and_mixed_problems() -> None:
    simulation = general(
        1, 2, seed=3, noise=Noise(SIGMA_M, KAPPA), odometry=15, odometry_noise=Noise(SIGMA_M, KAPPA), scale="shared"
    )
    for residual in ("chordal", "geodesic"):
        r = refined(simulation.problem, residual=residual)
        for name, T in (simulation.X | simulation.Y).items():
            assert r.contains(name, T, 0.9999)
    alone = general(0, 2, seed=3, odometry=30, odometry_noise=Noise(SIGMA_M, KAPPA))
    for residual in ("chordal", "geodesic"):
        r = refined(alone.problem, residual=residual)
        assert not r.free_directions
        assert r.contains("sensor1", alone.Y["sensor1"], 0.9999)


def test_a_world_origin_far_away_changes_nothing() -> None:
    problem = rig(seed=2).problem
    shift = se3.pose(np.eye(3), (4e5, -7e5, 2e5))
    far = copied(problem, A=lambda pair, raw: raw.A @ np.linalg.inv(shift))
    near, away = refined(problem, residual="chordal"), refined(far, residual="chordal")
    for name in ("sensor0", "sensor1"):
        np.testing.assert_allclose(near.Y[name].matrix(), away.Y[name].matrix(), atol=1e-6)
        np.testing.assert_allclose(near.covariance(name), away.covariance(name), rtol=1e-3, atol=1e-12)


def test_the_graph_takes_further_factors() -> None:
    """A user adds a factor of her own to the graph and optimises again."""
    r = refined(rig(seed=1).problem)
    graph = r.graph
    before = r.values.atPose3(r.keys["sensor0"])
    moved = before.retract(np.r_[0, 0, 0, 0.05, 0, 0])
    graph.add(gtsam.PriorFactorPose3(r.keys["sensor0"], moved, gtsam.noiseModel.Isotropic.Sigma(6, 1e-6)))
    after = gtsam.LevenbergMarquardtOptimizer(graph, r.values).optimize().atPose3(r.keys["sensor0"])
    assert after.equals(moved, 1e-4)


def test_a_known_size_other_than_one() -> None:
    """A tag known to be measured 1.5 times too long beside one of unknown size, in both residuals."""
    simulation = rig(
        2, 2, seed=3, scale="per_target", known_sizes=("target1",), true_scale={"target0": 0.7, "target1": 1.5}
    )
    for residual in ("geodesic", "chordal"):
        r = refined(simulation.problem, residual=residual)
        assert r.scale["target1"] == 1.5
        assert r.scale["target0"] == pytest.approx(0.7, abs=4 * np.sqrt(r.covariance("scale:target0")[0, 0]))
        for name, T in (simulation.X | simulation.Y).items():
            assert r.contains(name, T, 0.9999), name


def test_noise_given_too_small_is_warned_of_and_estimated_noise_is_not() -> None:
    problem = copied(rig(seed=4).problem, sigma=lambda pair, raw: 0.3 * raw.sigma)
    with pytest.warns(rw.errors.WeightsWarning, match="sigma and kappa predict"):
        solution = rw.solve(problem)
    with pytest.warns(rw.errors.WeightsWarning, match=r"standard deviations are too small by about \d"):
        rw.refine(problem, solution, rw.RefineOptions(noise="given"))
    with warnings.catch_warnings(action="error"):
        rw.refine(problem, solution, rw.RefineOptions(noise="estimate"))
        rw.refine(rig(seed=4).problem, rw.solve(rig(seed=4).problem))


def test_a_limit_of_iterations_is_warned_of() -> None:
    simulation = rig(seed=4, noise=Noise(0.05, 50.0))
    solution = rw.solve(simulation.problem)
    with pytest.warns(rw.errors.NotConvergedWarning, match="after 1 iterations"):
        rw.refine(simulation.problem, solution, rw.RefineOptions(max_iterations=1))


def test_two_measurements() -> None:
    """No degree of freedom, one turn only: the noise cannot be estimated, and no pose is determined."""
    problem = rig(1, 1, seed=5, number_of_measurements=2).problem
    r = refined(problem)
    assert len(r.free_directions) >= 1
    assert {name for direction in r.free_directions for name in direction.frames} == {"target0", "sensor0"}
    assert np.isinf(np.diag(r.covariance("sensor0"))).all()
    assert np.linalg.matrix_rank(r.information("sensor0")) == 4


def test_everything_fixed() -> None:
    simulation = rig(1, 1, seed=3)
    simulation.problem.fix("target0", simulation.X["target0"])
    simulation.problem.fix("sensor0", simulation.Y["sensor0"])
    for residual in ("chordal", "geodesic"):
        r = refined(simulation.problem, residual=residual)
        assert r.covariance().shape == (0, 0)
        assert r.covariance("sensor0").max() == 0.0


@pytest.mark.parametrize("tilt_rad", [0.0, 0.02, 0.04])
def test_a_free_direction_just_off_an_axis_is_not_forgotten(tilt_rad: float) -> None:
    """Planar motion, frames tilted a little against the plane: the free direction changes every axis by its share."""
    held = []
    for seed in range(12):
        generator = np.random.default_rng(seed)
        xi = np.zeros((40, 6))
        xi[:, 2] = generator.uniform(-3.0, 3.0, 40)
        A = se3.expmap(xi)
        A[:, :2, 3] = generator.uniform(-1.0, 1.0, (40, 2))
        X, Y = se3.expmap(np.array([[tilt_rad, 0.0, 2.0, 0.5, 0.3, 1.0], [0.0, tilt_rad, -1.0, 0.1, 0.2, 0.3]]))
        problem = rw.Problem()
        problem.add("t", "s", A, perturb(np.linalg.inv(Y) @ A @ X, Noise(SIGMA_M, KAPPA), generator), SIGMA_M, KAPPA)
        r = refined(problem)
        held += [r.contains("t", X), r.contains("s", Y)]
        millimetres = r.standard_deviations("t")[1]
        assert millimetres[2] == np.inf
        assert millimetres[:2].max() > 300.0 * tilt_rad  # displaced by decimetres
    assert np.mean(held) > 0.8


def test_estimated_noise_of_correlated_covariances() -> None:
    """Degrees of freedom are not overestimated, and covariances nine times too large are found to be so."""
    factors = []
    for seed in range(6):
        generator = np.random.default_rng(seed)
        raw = rig(1, 1, seed=seed, noise=None, number_of_measurements=60).problem.measurements("target0", "sensor0")
        L = 0.004 * generator.standard_normal((60, 6, 6))
        covariances = L @ L.transpose(0, 2, 1) + 1e-7 * np.eye(6)
        xi = np.array([generator.multivariate_normal(np.zeros(6), C) for C in covariances])
        problem = rw.Problem()
        problem.add("target0", "sensor0", raw.A, raw.B @ se3.expmap(xi), covariances=9.0 * covariances)
        r = refined(problem, noise="estimate")
        noise = r.noise["target0", "sensor0"]
        assert sum(noise.degrees_of_freedom) == pytest.approx(6 * 60 - 12, abs=1.0)
        given_m2 = 9.0 * np.median(np.einsum("nii->ni", covariances)[:, 3:].mean(axis=1))
        factors.append(noise.translation_m**2 / given_m2)
    assert np.mean(factors) == pytest.approx(1.0 / 9.0, rel=0.2)
