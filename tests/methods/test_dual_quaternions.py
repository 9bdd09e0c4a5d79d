from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from simulated import poses

from gtsam_rwhec.geometry.quaternions import right
from gtsam_rwhec.methods.dual_quaternion_cost import from_transforms, times_vectors, to_transform


def product(q: np.ndarray, p: np.ndarray) -> np.ndarray:
    """Hamilton's product, xyzw, written out."""
    return np.append(q[3] * p[:3] + p[3] * q[:3] + np.cross(q[:3], p[:3]), q[3] * p[3] - q[:3] @ p[:3])


@given(st.integers(0, 10_000), st.sampled_from([0.0, 1e-12, 1e-6, 1.0, np.pi - 1e-9, np.pi]))
def test_a_pose_and_back(seed: int, angle: float) -> None:
    rng = np.random.default_rng(seed)
    axis = rng.normal(size=(1, 3))
    T = poses(angle * axis / np.linalg.norm(axis), rng.normal(size=(1, 3)))
    (q,), (q_dual,) = from_transforms(T)
    assert abs(q @ q - 1.0) < 1e-14
    assert abs(q @ q_dual) < 1e-14
    assert q[3] >= 0.0
    for sign in (1.0, -1.0):
        assert to_transform(sign * q, sign * q_dual) == pytest.approx(T[0], abs=1e-14)
    assert to_transform(2.0 * q, 2.0 * q_dual) == pytest.approx(T[0], abs=1e-14)
    assert to_transform(q, q_dual + 0.3 * q) == pytest.approx(T[0], abs=1e-14)


def test_scipy_has_the_same_quaternion() -> None:
    T = poses(np.random.default_rng(0).normal(size=(50, 3)), np.zeros((50, 3)))
    q, _ = from_transforms(T)
    theirs = Rotation.from_matrix(T[:, :3, :3]).as_quat(canonical=True)
    assert np.abs(q - theirs).max() < 1e-14


def test_products_of_poses_are_products_of_dual_quaternions() -> None:
    rng = np.random.default_rng(1)
    T = poses(rng.normal(size=(2, 3)), rng.normal(size=(2, 3)))
    (q, p), (q_dual, p_dual) = from_transforms(T)
    assert to_transform(product(q, p), product(q, p_dual) + product(q_dual, p)) == pytest.approx(T[0] @ T[1], abs=1e-14)


def test_a_turn_by_a_vector_is_a_product() -> None:
    q = np.random.default_rng(2).normal(size=4)
    assert times_vectors(q) == pytest.approx(right(q)[:, :3])


def test_a_zero_quaternion_is_refused() -> None:
    with pytest.raises((ValueError, ZeroDivisionError)):
        to_transform(np.zeros(4), np.ones(4))
