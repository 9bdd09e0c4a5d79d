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
from gtsam_rwhec.methods.dq_descent import (
    chordal_moments,
    chordal_residuals,
    chvecopt,
    daniilidis,
    dqnlopt,
    dqnlopt_random,
    quatvecopt,
    root,
    rotation_slopes,
    unit_combination,
)
from gtsam_rwhec.methods.dqopt import dqopt
from gtsam_rwhec.methods.dual_quaternion_cost import from_transforms, to_transform
from gtsam_rwhec.methods.hand_eye_request import DualQuaternionPrior
from gtsam_rwhec.methods.motions import motions_of, squared_residuals


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


@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 10**6))
def test_forms_of_eq_30_are_its_sums(seed):
    data = hand_held(9, seed, 0.3, 0.3)
    motions = motions_of(data.C, data.H)
    weights = np.random.default_rng(seed).uniform(0.0, 2.0, 9)
    of_R, of_T = chordal_moments(motions, weights)
    x = np.concatenate([data.X[:3, :3].ravel(), data.X[:3, 3], [1.0]])
    E = data.C @ data.X - data.X @ data.H
    assert x[:9] @ of_R @ x[:9] == pytest.approx((weights * (E[:, :3, :3] ** 2).sum(axis=(1, 2))).sum(), rel=1e-8)
    assert x @ of_T @ x == pytest.approx((weights * (E[:, :3, 3] ** 2).sum(axis=1)).sum(), rel=1e-8)
    assert chordal_residuals(motions, data.X, weights) == pytest.approx((x[:9] @ of_R @ x[:9], x @ of_T @ x), rel=1e-8)


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


def test_half_the_slopes_times_q_are_the_rotations_entries():
    def entries(q):
        return 0.5 * rotation_slopes(q) @ q

    rng = np.random.default_rng(0)
    for q in rng.normal(size=(20, 4)):
        q /= np.linalg.norm(q)
        np.testing.assert_allclose(entries(q).reshape(3, 3), Rotation.from_quat(q).as_matrix(), atol=1e-14)
        steps = 1e-6 * np.eye(4)
        numeric = np.array([(entries(q + s) - entries(q - s)) / 2e-6 for s in steps]).T
        np.testing.assert_allclose(rotation_slopes(q), numeric, atol=1e-8)


def test_the_square_of_a_root_is_its_form():
    A = np.random.default_rng(0).normal(size=(3, 5))
    np.testing.assert_allclose(root(A.T @ A).T @ root(A.T @ A), A.T @ A, atol=1e-13)


def skew(v):
    return np.array([[0, -v[2], v[1]], [v[2], 0, -v[0]], [-v[1], v[0], 0]])


def by_singular_vectors(C, H, alpha):
    """His eqs. 31-35 row by row, the unknown (scalar, vector) as he has it."""
    rows = []
    for a, da, b, db in zip(*from_transforms(C), *from_transforms(H), strict=True):
        P = np.column_stack([(a - b)[:3], skew((a + b)[:3])])
        D = np.column_stack([(da - db)[:3], skew((da + db)[:3])]) * alpha
        rows += [np.hstack([P, np.zeros((3, 4))]), np.hstack([D, P])]
    *_, v7, v8 = np.linalg.svd(np.concatenate(rows))[2]
    u1, v1, u2, v2 = v7[:4], v7[4:], v8[:4], v8[4:]
    s = np.roots([u1 @ v1, u1 @ v2 + u2 @ v1, u2 @ v2])
    lengths = s**2 * (u1 @ u1) + 2 * s * (u1 @ u2) + u2 @ u2
    second = 1.0 / np.sqrt(lengths.max())
    q, dual = s[lengths.argmax()] * second * np.stack([u1, v1]) + second * np.stack([u2, v2])
    X = to_transform(np.roll(q, -1), np.roll(dual, -1))
    X[:3, 3] /= alpha
    return X


@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 10**6), alpha=st.floats(0.1, 10.0))
def test_moments_give_the_singular_vectors_of_all_rows(seed, alpha):
    data = hand_held(12, seed, largest_rad=2.5)
    X = daniilidis(request_of(data.C, data.H, alpha)).X
    np.testing.assert_allclose(X, by_singular_vectors(data.C, data.H, alpha), atol=1e-8)


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


def test_it_degrades_on_nearly_planar_motion_where_dqopt_does_not():
    ratios = []
    for seed in range(10):
        data = planar(100, seed)
        request = request_of(data.C, data.H)
        ratios.append(distance(pose(daniilidis(request).X), data.X)[1] / distance(pose(dqopt(request).X), data.X)[1])
    assert np.median(ratios) > 1.0  # Table 2, circular and linear


def test_a_null_vector_whose_coefficient_is_zero_does_no_harm():
    q, dual = np.array([0.0, 0.0, 0.6, 0.8]), np.array([0.5, 0.1, 0.0, 0.0])
    for first, second in (((q, dual), (0 * q, q)), ((0 * q, q), (q, dual))):
        u, v = np.column_stack([first[0], second[0]]), np.column_stack([first[1], second[1]])
        found = np.concatenate(unit_combination(u, v))
        np.testing.assert_allclose(found * np.sign(found[3]), np.concatenate([q, dual]), atol=1e-14)


def test_null_vectors_without_a_rotation_are_refused():
    with pytest.raises(UnderdeterminedError, match="no rotation"):
        unit_combination(np.zeros((4, 2)), np.eye(4)[:, :2])
