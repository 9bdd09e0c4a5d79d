"""Daniilidis' linear method: against singular vectors of the stacked rows, exact motions, degenerate ones."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from method_requests import pose, request_of
from simulated import distance, hand_held, planar, poses

from gtsam_rwhec.errors import UnderdeterminedError
from gtsam_rwhec.methods.dq_descent import daniilidis, unit_combination
from gtsam_rwhec.methods.dqopt import dqopt
from gtsam_rwhec.methods.dual_quaternion_cost import from_transforms, to_transform


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
