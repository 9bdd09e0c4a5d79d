from __future__ import annotations

import gtsam
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from rwhec_factors import se3

#: Zero, series, both sides of where series end, the middle, and ever nearer to half a turn.
ANGLES = [0.0, 1e-12, 1e-8, 1e-5, 9.9e-3, 1.01e-2, 0.0999, 0.1001, 1.0, 2.999, 3.001, np.pi - 1e-3, np.pi - 1e-7]


def tangents(angle: float, count: int = 20) -> np.ndarray:
    generator = np.random.default_rng(0)
    xi = generator.standard_normal((count, 6))
    xi[:, :3] *= angle / np.linalg.norm(xi[:, :3], axis=1)[:, None]
    return xi


@pytest.mark.parametrize("angle", ANGLES)
def test_expmap_and_the_inverse_jacobian_are_gtsams(angle: float) -> None:
    xi = tangents(angle)
    expected = np.array([gtsam.Pose3.Expmap(x).matrix() for x in xi])
    np.testing.assert_allclose(se3.expmap(xi), expected, atol=1e-14)
    # GTSAM's LogmapDerivative is a series near half a turn, 5e-8 off at 1e-3 from it; ExpmapDerivative is not.
    jacobians = np.array([gtsam.Pose3.ExpmapDerivative(x) for x in xi])
    np.testing.assert_allclose(
        se3.right_jacobian_inverse(xi) @ jacobians, np.tile(np.eye(6), (len(xi), 1, 1)), atol=1e-12
    )


@pytest.mark.parametrize("angle", ANGLES)
def test_logmap_undoes_expmap(angle: float) -> None:
    xi = tangents(angle)
    np.testing.assert_allclose(se3.logmap(se3.expmap(xi)), xi, atol=2e-14)


def test_logmap_of_half_a_turn_is_half_a_turn() -> None:
    xi = tangents(np.pi)
    T = se3.expmap(xi)
    found = se3.logmap(T)
    np.testing.assert_allclose(np.linalg.norm(found[:, :3], axis=1), np.pi, atol=1e-14)
    np.testing.assert_allclose(se3.expmap(found), T, atol=1e-14)


@pytest.mark.parametrize("angle", [0.0, 1e-3, 0.05, 0.5, 2.0, 3.0])
def test_inverse_jacobian_is_the_numeric_one(angle: float) -> None:
    xi = tangents(angle)
    T, step = se3.expmap(xi), 1e-5
    columns = []
    for direction in np.eye(6):
        ahead, back = (se3.logmap(T @ se3.expmap(sign * step * direction[None])) for sign in (1.0, -1.0))
        columns.append((ahead - back) / (2.0 * step))
    np.testing.assert_allclose(se3.right_jacobian_inverse(xi), np.stack(columns, axis=-1), atol=1e-8)


@settings(max_examples=50, deadline=None)
@given(st.lists(st.floats(-3.0, 3.0), min_size=12, max_size=12))
def test_inverse_and_adjoint(numbers: list[float]) -> None:
    xi, d = np.array(numbers[:6])[None], np.array(numbers[6:])[None]
    T = se3.expmap(xi)
    np.testing.assert_allclose(se3.inverse(T) @ T, np.eye(4)[None], atol=1e-12)
    moved = se3.expmap(np.einsum("nij,nj->ni", se3.adjoint(T), d))
    np.testing.assert_allclose(T @ se3.expmap(d) @ se3.inverse(T), moved, atol=1e-10)
