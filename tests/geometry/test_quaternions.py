"""Quaternions against GTSAM's, and their products against Hamilton's written out."""

from __future__ import annotations

import gtsam
import numpy as np
import pytest

from gtsam_rwhec.geometry.quaternions import conjugate, dual_parts, left, of_rotations, right, to_rotations
from gtsam_rwhec.simulate.simulated_noise import random_poses


def product(q: np.ndarray, p: np.ndarray) -> np.ndarray:
    """Hamilton's product, xyzw, written out."""
    return np.append(q[3] * p[:3] + p[3] * q[:3] + np.cross(q[:3], p[:3]), q[3] * p[3] - q[:3] @ p[:3])


def test_quaternions_are_gtsams_up_to_sign() -> None:
    half_turns = [np.diag(d) for d in ([1.0, -1.0, -1.0], [-1.0, 1.0, -1.0], [-1.0, -1.0, 1.0], [1.0, 1.0, 1.0])]
    R = np.concatenate([random_poses(50, 1.0, np.random.default_rng(0))[:, :3, :3], half_turns])
    q = of_rotations(R)
    expected = np.array([gtsam.Rot3(one).toQuaternion().coeffs() for one in R])
    np.testing.assert_allclose(np.abs(np.einsum("ni,ni->n", q, expected)), 1.0, atol=1e-15)
    np.testing.assert_allclose(to_rotations(2.0 * q), R, atol=1e-14)
    np.testing.assert_allclose(to_rotations(q[3]), R[3], atol=1e-14)


def test_left_and_right_are_the_product() -> None:
    q, p = np.random.default_rng(2).normal(size=(2, 4))
    assert left(q) @ p == pytest.approx(product(q, p))
    assert right(p) @ q == pytest.approx(product(q, p))
    assert left(np.array([q, p]))[1] == pytest.approx(left(p))
    assert right(np.array([q, p]))[0] == pytest.approx(right(q))
    assert product(q, conjugate(q)) == pytest.approx([0, 0, 0, q @ q])
    assert dual_parts(q[None], p[None, :3])[0] == pytest.approx(0.5 * product(np.append(p[:3], 0.0), q))


def test_a_product_turns_after_the_other() -> None:
    R, S = random_poses(2, 1.0, np.random.default_rng(1))[:, :3, :3]
    q, p = of_rotations(np.array([R, S]))
    np.testing.assert_allclose(to_rotations(left(q) @ p), R @ S, atol=1e-14)
