"""Stating a problem: the calls as documented, batches, what is kept, knowledge of frames, joining."""

from __future__ import annotations

import pickle
import warnings
from typing import Any

import gtsam
import numpy as np
import pytest
from rwhec_factors.se3 import inverse, pose

import gtsam_rwhec as rw
from gtsam_rwhec.errors import FrameError, MeasurementsNotKeptError, RotationsProjectedWarning, UnitsWarning
from gtsam_rwhec.problem.measurements import Pair
from gtsam_rwhec.simulate import Noise, general
from gtsam_rwhec.simulate.simulated_noise import random_poses
from gtsam_rwhec.solver import Start

GENERATOR = np.random.default_rng(0)
X_TRUE, Y_TRUE = random_poses(2, 1.0, GENERATOR)
A = random_poses(12, 1.0, GENERATOR)
B = inverse(Y_TRUE) @ A @ X_TRUE
A_MOTION = random_poses(6, 1.0, GENERATOR)
B_MOTION = inverse(Y_TRUE) @ A_MOTION @ Y_TRUE


def rows_of(transforms: np.ndarray) -> np.ndarray:
    """qw, qx, qy, qz, tx, ty, tz."""
    quaternions = np.array([gtsam.Rot3(T[:3, :3]).toQuaternion().coeffs()[[3, 0, 1, 2]] for T in transforms])
    return np.concatenate([quaternions, transforms[:, :3, 3]], axis=1)


def assert_same_moments(got: rw.Problem, expected: rw.Problem, relative: float = 1e-12) -> None:
    assert got.pairs == expected.pairs
    for pair in got.pairs:
        moments, others = got.moments(*pair), expected.moments(*pair)
        assert moments.count == others.count
        for a, b in ((moments.translation, others.translation), (moments.rotation, others.rotation)):
            np.testing.assert_allclose(a, b, rtol=0.0, atol=relative * np.abs(b).max())


def test_the_calls_of_the_documentation_work_as_written(utias_folder: Any) -> None:
    rows_A, rows_B = rows_of(A), rows_of(B)
    T, T_carrier_target = gtsam.Pose3(Y_TRUE), gtsam.Pose3(X_TRUE)

    problem = rw.Problem(scale="known")
    problem.add(target="tag0", sensor="cam0", A=A, B=B, sigma=0.01, kappa=125.0)
    problem.add(target="tag0", sensor="cam0", A=rows_A, B=rows_B, order="wxyz")
    problem.add_motion(sensor="cam0", A=A_MOTION, B=B_MOTION)
    assert problem.pairs == (("tag0", "cam0"), ("cam0", "cam0"))
    assert problem.number_of_measurements == 12 + 12 + 6
    assert problem.is_relative  # the second batch has no weights
    solution = rw.solve(problem, method="auto")
    np.testing.assert_allclose(solution.X["tag0"].matrix(), X_TRUE, atol=1e-8)
    np.testing.assert_allclose(solution.Y["cam0"].matrix(), Y_TRUE, atol=1e-8)
    X, Y = solution.X, solution.Y
    assert rw.certify(problem, X=X, Y=Y, scale=1.0).status == "certified"

    problem.fix("tag0", T_carrier_target)
    problem.add_prior("cam0", T, sigma=0.005, kappa=1e4)
    local = rw.solve(problem, method="local", initial=(X, Y, 1.0), options=rw.SolveOptions(relative_tolerance=1e-7))
    assert local.certificate.is_certified
    assert rw.solve(problem, method="sdp").certificate.is_certified
    assert issubclass(rw.errors.RwhecError, Exception)

    problem = rw.read_csv(utias_folder, scale="shared", sigma=1.0, kappa=1.0)
    solution = rw.solve(problem, method="auto")
    assert isinstance(solution.X["tag_0"], gtsam.Pose3)
    assert isinstance(solution.Y["cam_0"], gtsam.Pose3)
    assert isinstance(solution.scale, float)
    c = solution.certificate
    assert c.status == "certified"
    assert c.is_certified is True
    assert c.lower_bound <= c.cost
    assert 0.0 <= c.relative_gap < 1e-7
    assert np.isfinite(c.min_eigenvalue)
    assert c.path.start is Start.SPECTRAL
    assert all(seconds >= 0.0 for seconds in c.seconds.values())
    assert "A X = Y B" in str(c.objective)
    assert solution.identifiability.is_unique is True
    assert solution.identifiability.free_directions == ()


@pytest.mark.parametrize(
    ("forms", "order"),
    [
        ((list(A), list(B)), None),
        (([gtsam.Pose3(T) for T in A], [gtsam.Pose3(T) for T in B]), None),
        (([gtsam.Pose3(T) for T in A], B), None),
        ((rows_of(A), rows_of(B)), "wxyz"),
        ((rows_of(A)[:, [1, 2, 3, 0, 4, 5, 6]], rows_of(B)[:, [1, 2, 3, 0, 4, 5, 6]]), "xyzw"),
    ],
    ids=["list of arrays", "Pose3", "mixed", "wxyz", "xyzw"],
)
@pytest.mark.parametrize("motion", [False, True])
def test_every_form_of_poses_is_the_same_problem(forms: Any, order: Any, motion: bool) -> None:
    problem, expected = rw.Problem(), rw.Problem()
    if motion:
        problem.add_motion("cam0", *forms, 0.1, 3.0, order=order)
        expected.add_motion("cam0", A, B, 0.1, 3.0)
    else:
        problem.add("tag0", "cam0", *forms, 0.1, 3.0, order=order)
        expected.add("tag0", "cam0", A, B, 0.1, 3.0)
    assert_same_moments(problem, expected)
    kept = problem.measurements(*problem.pairs[0])
    np.testing.assert_allclose(kept.A, A, atol=1e-15 * 8)
    np.testing.assert_allclose(kept.B, B, atol=1e-15 * 8)


def test_poses_one_at_a_time() -> None:
    problem, expected = rw.Problem(), rw.Problem()
    for i in range(len(A)):
        one = (gtsam.Pose3(A[i]), gtsam.Pose3(B[i])) if i % 2 else (A[i], B[i])
        problem.add("tag0", "cam0", *one, sigma=0.1 + i, kappa=[3.0 + i])
    expected.add("tag0", "cam0", A, B, 0.1 + np.arange(12), 3.0 + np.arange(12))
    assert_same_moments(rw.Problem() + problem, problem)
    for X, Y in ((X_TRUE, Y_TRUE), random_poses(2, 1.0, GENERATOR)):
        costs = [rw.certify(p, {"tag0": X}, {"cam0": Y}).cost for p in (problem, expected)]
        assert costs[0] == pytest.approx(costs[1], rel=1e-11, abs=1e-9)


def test_names_and_counts() -> None:
    problem = rw.Problem()
    problem.add("b", "y", A[:5], B[:5])
    problem.add("a", "y", A[:4], B[:4])
    problem.add("a", "x", A[:3], B[:3])
    problem.add_motion("z", A_MOTION, B_MOTION)
    problem.add("b", "y", A[5:7], B[5:7])
    assert problem.targets == ("b", "a")
    assert problem.sensors == ("y", "x", "z")
    assert problem.pairs == (("b", "y"), ("a", "y"), ("a", "x"), ("z", "z"))
    assert [problem.moments(*pair).count for pair in problem.pairs] == [7, 4, 3, 6]
    assert problem.number_of_measurements == 20
    assert repr(problem) == "Problem(2 targets, 3 sensors, 4 pairs, 20 measurements, scale='known')"
    with pytest.raises(FrameError, match="no measurements of b-x"):
        problem.moments("b", "x")


@pytest.mark.parametrize(
    ("weights", "relative"),
    [({}, True), ({"sigma": 0.1}, True), ({"kappa": 2.0}, True), ({"sigma": 0.1, "kappa": 2.0}, False)],
)
def test_weights_left_out_are_one_and_relative(weights: dict[str, float], relative: bool) -> None:
    problem, expected = rw.Problem(), rw.Problem()
    problem.add("t", "s", A, B, **weights)
    expected.add("t", "s", A, B, **{"sigma": 1.0, "kappa": 1.0, **weights})
    assert problem.is_relative is relative
    assert expected.is_relative is False
    assert_same_moments(problem, expected)
    assert rw.solve(problem).is_relative is relative
    assert rw.solve(problem).certificate.is_relative is relative
    assert (problem + expected).is_relative is (expected + problem).is_relative is relative


def test_measurements_are_kept_as_they_came() -> None:
    problem = rw.Problem()
    stamps = np.arange(12) * 10**9
    problem.add("t", "s", A[:5], B[:5], 0.1, np.arange(1.0, 6.0), stamps_ns=stamps[:5])
    problem.add("t", "s", A[5:], B[5:], 0.2, 7.0, stamps_ns=stamps[5:])
    kept = problem.measurements("t", "s")
    np.testing.assert_array_equal(kept.A, A)
    np.testing.assert_array_equal(kept.B, B)
    np.testing.assert_array_equal(kept.sigma, [0.1] * 5 + [0.2] * 7)
    np.testing.assert_array_equal(kept.kappa, [1.0, 2.0, 3.0, 4.0, 5.0] + [7.0] * 7)
    np.testing.assert_array_equal(kept.stamps_ns, stamps)
    assert kept.stamps_ns is not None
    assert kept.stamps_ns.dtype == np.int64
    assert kept.covariances is None
    assert not problem.has_covariances


def test_covariances_are_kept_and_weigh_the_certified_form_by_their_means() -> None:
    full = np.diag(np.arange(1.0, 7.0)) + 0.1
    problem, same = rw.Problem(), rw.Problem()
    problem.add("t", "s", A[:5], B[:5], covariances=np.tile(full, (5, 1, 1)))
    sigma, kappa = np.sqrt(5.0 + 0.1), 0.5 / (2.0 + 0.1)
    same.add("t", "s", A[:5], B[:5], sigma, kappa)
    assert problem.has_covariances
    assert not problem.is_relative
    assert_same_moments(problem, same)
    # A batch with sigma and kappa beside it has a covariance too, the diagonal one.
    problem.add("t", "s", A[5:], B[5:], 0.2, 7.0)
    kept = problem.measurements("t", "s").covariances
    assert kept is not None
    np.testing.assert_array_equal(kept[:5], np.tile(full, (5, 1, 1)))
    np.testing.assert_allclose(kept[5:], np.tile(np.diag([1 / 14] * 3 + [0.04] * 3), (7, 1, 1)), rtol=1e-15)


@pytest.mark.parametrize("weights", [{"sigma": 0.1}, {"kappa": 3.0}])
def test_covariances_and_weights_at_once_are_refused(weights: dict[str, float]) -> None:
    problem = rw.Problem()
    with pytest.raises(rw.errors.NoiseError, match=f"t-s: covariances and {next(iter(weights))} are given"):
        problem.add("t", "s", A, B, covariances=np.eye(6), **weights)
    assert problem.pairs == ()


def test_what_is_kept_does_not_change_with_the_callers_arrays() -> None:
    mine_A, mine_B, mine_sigma = A.copy(), B.copy(), np.full(12, 0.1)
    problem = rw.Problem()
    problem.add("t", "s", mine_A, mine_B, mine_sigma, 1.0)
    before = pickle.dumps(problem)
    mine_A[:] = mine_B[:] = np.nan
    mine_sigma[:] = -1.0
    assert pickle.dumps(problem) == before


@pytest.mark.parametrize("batches", [1, 40])
def test_without_measurements_memory_does_not_grow(batches: int) -> None:
    """The whole state of a problem, pickled, is as large after 40 batches as after one."""
    problem = rw.Problem(keep_measurements=False)
    many = random_poses(200, 1.0, np.random.default_rng(1))
    for _ in range(batches):
        problem.add("t", "s", many, many, np.full(200, 0.1), 1.0, stamps_ns=np.arange(200))
    assert problem.number_of_measurements == 200 * batches
    # What centring keeps of the first measurements is bounded: a multiple of one block, whatever comes after.
    assert len(pickle.dumps(problem)) < 2_000_000
    with pytest.raises(MeasurementsNotKeptError, match=r"t-s were not kept.*keep_measurements=True"):
        problem.measurements("t", "s")


def test_moments_alone_give_the_same_solution() -> None:
    kept = general(2, 2, seed=1, noise=Noise(0.01, 500.0), odometry=5, odometry_noise=Noise(0.02, 100.0))
    lean = general(
        2, 2, seed=1, noise=Noise(0.01, 500.0), odometry=5, odometry_noise=Noise(0.02, 100.0), keep_measurements=False
    )
    first, second = rw.solve(kept.problem), rw.solve(lean.problem)
    # One cost is that of the measurements, the other that of their moments, which are rounded.
    assert first.cost == pytest.approx(second.cost, rel=1e-11)
    for name, T in {**first.X, **first.Y}.items():
        np.testing.assert_allclose(T.matrix(), {**second.X, **second.Y}[name].matrix(), atol=1e-11)


def test_knowledge_of_frames() -> None:
    problem = rw.Problem()
    problem.add("t", "s", A, B, 0.01, 100.0)
    problem.fix("t", X_TRUE)
    problem.fix("t", gtsam.Pose3(X_TRUE))  # the same, said twice
    problem.add_prior("s", Y_TRUE, sigma=0.1)
    problem.add_prior("s", gtsam.Pose3(Y_TRUE), kappa=10.0)
    np.testing.assert_allclose(problem.fixed["t"], X_TRUE, atol=1e-15)
    assert [(p.sigma, p.kappa) for p in problem.priors["s"]] == [(0.1, None), (None, 10.0)]
    solution = rw.solve(problem)
    np.testing.assert_allclose(solution.X["t"].matrix(), X_TRUE, atol=1e-12)
    assert solution.certificate.objective.has_priors


def test_a_prior_pulls_as_its_weights_say() -> None:
    """One measurement and one prior of the same weight: the estimate is half way."""
    eye, off = np.eye(4), pose(np.eye(3), [0.02, 0.0, 0.0])
    problem = rw.Problem()
    problem.add("t", "s", eye, off, sigma=0.1, kappa=50.0)
    problem.fix("t", eye)
    problem.add_prior("s", eye, sigma=0.1, kappa=50.0)  # the measurement says -off
    solution = rw.solve(problem)
    np.testing.assert_allclose(solution.Y["s"].translation(), [-0.01, 0.0, 0.0], atol=1e-12)
    assert solution.cost == pytest.approx(2 * 0.5 * 0.01**2 / 0.1**2)


def test_millimetres_are_told_from_metres() -> None:
    in_mm_A, in_mm_B = A.copy(), B.copy()
    in_mm_A[:, :3, 3] *= 1000.0
    in_mm_B[:, :3, 3] *= 1000.0
    problem = rw.Problem()
    with pytest.warns(UnitsWarning) as caught:
        problem.add("tag", "cam", in_mm_A, in_mm_B, source="log 7")
    (message,) = [str(w.message) for w in caught]
    assert "translations of A and B" in message
    assert "tag-cam (log 7)" in message
    assert "divide by 1000" in message
    assert any(character.isdigit() for character in message.split("median size of ")[1][:3])
    assert problem.number_of_measurements == 12  # a warning, not a refusal


@pytest.mark.parametrize("side", ["sensor carrier", "target carrier"])
def test_a_far_world_is_no_millimetre(side: str) -> None:
    far = pose(np.eye(3), [2e5, -1e6, 3e5])
    moved = far @ A if side == "sensor carrier" else A @ far
    with warnings.catch_warnings(action="error"):
        rw.Problem().add("tag", "cam", moved, B)


def test_projection_is_counted_and_said() -> None:
    single = A.astype(np.float32).astype(float)
    problem = rw.Problem()
    with pytest.warns(RotationsProjectedWarning, match=r"tag-cam \(file\.csv\): 12 rotations .* were projected"):
        problem.add("tag", "cam", single, B, source="file.csv")
    assert problem.moments("tag", "cam").projected == 12


def test_merging_is_adding() -> None:
    one, two, both = rw.Problem(), rw.Problem(), rw.Problem()
    for problem in (one, both):
        problem.add("t", "s", A[:6], B[:6], 0.1, 2.0)
        problem.add_prior("s", Y_TRUE, kappa=10.0)
    for problem in (two, both):
        problem.add("t", "s", A[6:], B[6:], 0.3, 5.0)
        problem.add("u", "s", A, B, 0.3, 5.0)
        problem.fix("u", X_TRUE)
    merged = one + two
    assert_same_moments(merged, both, 1e-9)
    assert (merged.targets, merged.sensors) == (both.targets, both.sensors)
    assert merged.fixed.keys() == both.fixed.keys()
    np.testing.assert_array_equal(merged.measurements("t", "s").A, A)
    assert rw.solve(merged).cost == pytest.approx(rw.solve(both).cost, abs=1e-12)
    # The parts are as they were.
    assert one.number_of_measurements == 6
    assert two.number_of_measurements == 18
    assert "u" not in one.targets
    assert not one.fixed


def test_merging_with_an_empty_problem_changes_nothing() -> None:
    problem = rw.Problem()
    problem.add("t", "s", A, B, 0.1, 2.0)
    for merged in (problem + rw.Problem(), rw.Problem() + problem):
        assert_same_moments(merged, problem)
        assert merged.is_relative is False


def test_merging_per_target_scales() -> None:
    one, two = rw.Problem("per_target"), rw.Problem("per_target")
    one.add("t", "s", A, B)
    two.add("u", "s", A, B)
    one.fix_scale("t")
    two.fix_scale("u", 2.0)
    assert (one + two).fixed_scales == {"t": 1.0, "u": 2.0}


def test_measurements_not_kept_in_one_are_not_kept_in_both() -> None:
    kept, lean = rw.Problem(), rw.Problem(keep_measurements=False)
    for problem in (kept, lean):
        problem.add("t", "s", A, B)
    for merged in (kept + lean, lean + kept):
        assert merged.keep_measurements is False
        with pytest.raises(MeasurementsNotKeptError):
            merged.measurements("t", "s")


def test_a_pair_is_a_tuple_and_found_as_one() -> None:
    pair = Pair("tag_0", "cam_0")
    assert pair == ("tag_0", "cam_0")
    assert {pair: 1}["tag_0", "cam_0"] == 1
    assert pickle.loads(pickle.dumps(pair)).label == "tag_0-cam_0"


def test_its_label_is_how_it_is_written() -> None:
    assert f"{Pair('tag_0', 'cam_0')}" == Pair("tag_0", "cam_0").label == "tag_0-cam_0"
    assert str(Pair("cam_0", "cam_0")) == "the motions of cam_0"


def test_motions_have_one_frame() -> None:
    motions, seen = Pair("cam_0", "cam_0"), Pair("tag_0", "cam_0")
    assert motions.is_motion
    assert not seen.is_motion
    assert motions.frames == ("cam_0",)
    assert seen.frames == ("tag_0", "cam_0")
