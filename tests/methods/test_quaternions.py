"""Quaternions and the signs of a measurement's two."""

from __future__ import annotations

import gtsam
import numpy as np
import pytest
from method_problems import general_pair

from gtsam_rwhec.methods import quaternions
from gtsam_rwhec.methods.absolute import Stack
from gtsam_rwhec.simulate.transforms import random_poses


def gtsams(R: np.ndarray) -> np.ndarray:
    q = gtsam.Rot3(R).toQuaternion()
    return np.array([q.w(), q.x(), q.y(), q.z()])


def test_quaternions_are_gtsams_up_to_sign() -> None:
    half_turns = [np.diag(d) for d in ([1.0, -1.0, -1.0], [-1.0, 1.0, -1.0], [-1.0, -1.0, 1.0], [1.0, 1.0, 1.0])]
    R = np.concatenate([random_poses(50, 1.0, np.random.default_rng(0))[:, :3, :3], half_turns])
    q = quaternions.of_rotations(R)
    expected = np.array([gtsams(one) for one in R])
    np.testing.assert_allclose(np.abs(np.einsum("ni,ni->n", q, expected)), 1.0, atol=1e-15)
    np.testing.assert_allclose([quaternions.to_rotation(2.0 * one) for one in q], R, atol=1e-14)


def test_left_and_right_are_the_product() -> None:
    R, S = random_poses(2, 1.0, np.random.default_rng(1))[:, :3, :3]
    p, q = quaternions.of_rotations(np.array([R, S]))
    product = quaternions.left(p) @ q
    np.testing.assert_allclose(quaternions.right(q) @ p, product, atol=1e-15)
    np.testing.assert_allclose(quaternions.to_rotation(product), R @ S, atol=1e-14)


@pytest.mark.parametrize("seed", range(5))
def test_signs_fit_together(seed: int) -> None:
    simulation = general_pair(seed=seed)
    q_A, q_B = quaternions.paired_quaternions(Stack.of(simulation.problem))
    q_X = gtsams(simulation.X["target0"][:3, :3])
    q_Y = gtsams(simulation.Y["sensor0"][:3, :3])
    products = np.einsum("ni,ni->n", quaternions.left(q_A) @ q_X, quaternions.right(q_B) @ q_Y)
    np.testing.assert_allclose(np.abs(products), 1.0, atol=0.05)
    assert abs(np.sign(products).sum()) == len(products)  # one sign for all, that of q_X and q_Y themselves
