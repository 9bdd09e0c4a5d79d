"""Nonlinear least squares on the DQ paper's costs."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from method_requests import pose, request_of
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation
from simulated import distance, hand_held, planar, poses

from gtsam_rwhec.errors import UnderdeterminedError
from gtsam_rwhec.methods.dq_descent import chvecopt, daniilidis, dqnlopt, dqnlopt_random, quatvecopt, unit_combination
from gtsam_rwhec.methods.dqopt import dqopt
from gtsam_rwhec.methods.dual_quaternion_cost import from_transforms
from gtsam_rwhec.methods.hand_eye_request import DualQuaternionPrior
from gtsam_rwhec.methods.motions import squared_residuals


def eq_8(request, X):
    (q,), (dual,) = from_transforms(X[None])
    rotation, translation = squared_residuals(request.motions, q, dual, request.weights)
    return rotation + request.alpha**2 * translation


@settings(max_examples=15, deadline=None)
@given(seed=st.integers(0, 10**6), alpha=st.floats(0.05, 20.0), flat=st.booleans())
def test_descent_from_dqopt_stays_there(seed, alpha, flat):
    data = planar(40, seed) if flat else hand_held(40, seed)
    request = request_of(data.C, data.H, alpha)
    best, found = eq_8(request, dqopt(request).X), eq_8(request, dqnlopt(request).X)
    assert abs(found / best - 1.0) < 1e-10


def test_descent_from_random_poses_never_ends_below_dqopt_and_mostly_there():
    reached = []
    for seed in range(60):
        data = hand_held(20, seed, 0.1, 0.1)
        request = request_of(data.C, data.H, rng=seed)
        ratio = eq_8(request, dqnlopt_random(request).X) / eq_8(request, dqopt(request).X)
        assert ratio >= 1.0 - 1e-12
        reached.append(ratio < 1.0 + 1e-9)
    assert np.mean(reached) > 0.5


def test_random_starts_are_told_by_the_generator():
    data = planar(20, 1, 0.1, 0.1)
    first, again = (dqnlopt_random(request_of(data.C, data.H, rng=5)).X for _ in range(2))
    np.testing.assert_array_equal(first, again)


def slow_minimum(data, alpha, weights, quaternion):
    """Eq. 30 with one residual for each entry of each motion, in a rotation vector about the truth."""
    q_C, q_H = (Rotation.from_matrix(T[:, :3, :3]) for T in (data.C, data.H))
    t_C, t_H = data.C[:, :3, 3], data.H[:, :3, 3]

    def parts(x):
        R = (Rotation.from_matrix(data.X[:3, :3]) * Rotation.from_rotvec(x[:3])).as_matrix()
        T = data.X[:3, 3] + x[3:]
        if quaternion:
            q = Rotation.from_matrix(R)
            first, second = (q_C * q).as_quat(), (q * q_H).as_quat()
            first *= np.sign((first * second).sum(axis=1))[:, None]
            rotation = first - second
        else:
            rotation = (q_C.as_matrix() @ R - R @ q_H.as_matrix()).reshape(-1, 9)
        return rotation, q_C.apply(T) - T - t_H @ R.T + t_C

    def residual(x):
        rotation, translation = parts(x)
        w = np.sqrt(weights)[:, None]
        return np.concatenate([(w * rotation).ravel(), (w * alpha * translation).ravel()])

    found = least_squares(residual, np.zeros(6), xtol=1e-15, ftol=1e-15, gtol=1e-15)
    return 2.0 * found.cost


@pytest.mark.parametrize(("method", "quaternion"), [(chvecopt, False), (quatvecopt, True)])
@pytest.mark.parametrize("alpha", [0.2, 1.0, 5.0])
def test_eq_30_against_all_residuals_one_by_one(method, quaternion, alpha):
    data = hand_held(30, 7, largest_rad=2.0)
    weights = np.random.default_rng(0).uniform(0.5, 2.0, 30)
    answer = method(request_of(data.C, data.H, alpha, weights=weights))
    assert answer.cost == pytest.approx(slow_minimum(data, alpha, weights, quaternion), rel=1e-9)
    angle, length = distance(pose(answer.X), data.X)
    assert angle < 0.02
    assert length < 0.02


def test_a_prior_is_part_of_dqnlopts_cost():
    data = planar(30, 2)
    prior = DualQuaternionPrior(data.X, 5.0, 50.0)
    request = request_of(data.C, data.H, prior=prior)
    exact, local = dqopt(request).X, dqnlopt(request).X
    np.testing.assert_allclose(local, exact, atol=1e-7)
    free = dqopt(request_of(data.C, data.H)).X
    assert distance(pose(local), data.X)[1] < distance(pose(free), data.X)[1]


def test_covariances_are_part_of_dqnlopts_cost():
    data = hand_held(30, 4)
    rng = np.random.default_rng(1)
    factor = rng.normal(size=(30, 8, 8))
    covariances = factor @ factor.transpose(0, 2, 1) + np.eye(8)
    request = request_of(data.C, data.H, covariances=covariances)
    np.testing.assert_allclose(dqnlopt(request).X, dqopt(request).X, atol=1e-6)


@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 10**6), count=st.integers(3, 50))
def test_exact_motions_give_the_truth(seed, count):
    data = hand_held(count, seed, 0.0, 0.0)
    angle, length = distance(pose(daniilidis(request_of(data.C, data.H)).X), data.X)
    assert angle < 1e-6
    assert length < 1e-5


def test_a_weight_counts_as_so_many_motions():
    data = hand_held(10, 3)
    weights = np.array([1.0, 2, 0, 3, 1, 1, 2, 1, 0, 1])
    repeated = np.repeat(np.arange(10), weights.astype(int))
    X = daniilidis(request_of(data.C, data.H, weights=weights)).X
    np.testing.assert_allclose(X, daniilidis(request_of(data.C[repeated], data.H[repeated])).X, atol=1e-10)


@pytest.mark.parametrize("turning", [0.0, 1.0])
def test_parallel_axes_and_pure_translation_are_refused(turning):
    rng = np.random.default_rng(0)
    H = poses(np.outer(rng.uniform(0.2, 1.0, 8), [0.0, 0.0, turning]), rng.normal(size=(8, 3)))
    X = poses(np.array([[0.3, -0.2, 0.5]]), np.array([[0.1, 0.2, 0.3]]))[0]
    with pytest.raises(UnderdeterminedError, match="parallel axes"):
        daniilidis(request_of(X @ H @ np.linalg.inv(X), H))


def test_a_null_vector_whose_coefficient_is_zero_does_no_harm():
    q, dual = np.array([0.0, 0.0, 0.6, 0.8]), np.array([0.5, 0.1, 0.0, 0.0])
    for first, second in (((q, dual), (0 * q, q)), ((0 * q, q), (q, dual))):
        u, v = np.column_stack([first[0], second[0]]), np.column_stack([first[1], second[1]])
        found = np.concatenate(unit_combination(u, v))
        np.testing.assert_allclose(found * np.sign(found[3]), np.concatenate([q, dual]), atol=1e-14)


def test_null_vectors_without_a_rotation_are_refused():
    with pytest.raises(UnderdeterminedError, match="no rotation"):
        unit_combination(np.zeros((4, 2)), np.eye(4)[:, :2])
