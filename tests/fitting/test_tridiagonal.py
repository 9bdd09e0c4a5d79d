"""Factors of block-tridiagonal precisions, and inverses of matrices of many frames, against dense matrices."""

from __future__ import annotations

import numpy as np
import pytest

from gtsam_rwhec.fitting.drift import ChainFactor
from gtsam_rwhec.fitting.joint_covariance import SMALL, EliminationOrder, JointCovariance
from gtsam_rwhec.fitting.unknowns import Unknown, UnknownKind


def blocks_of(T: int, s: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The precision of a random walk with measurements: its blocks, and the whole."""
    chance = np.random.default_rng(T)
    root = chance.normal(size=(T, s, s))
    diagonal, below = root @ root.transpose(0, 2, 1) + np.eye(s), np.zeros((T - 1, s, s))
    F = chance.normal(size=(T - 1, s, s))
    diagonal[:-1] += F.transpose(0, 2, 1) @ F
    below[:] = -F
    whole = np.zeros((T, s, T, s))
    at = np.arange(T)
    whole[at, :, at] = diagonal
    whole[at[1:], :, at[:-1]] = below
    whole[at[:-1], :, at[1:]] = below.transpose(0, 2, 1)
    return diagonal, below, whole.reshape(T * s, T * s)


@pytest.mark.parametrize(("T", "s"), [(1, 3), (2, 1), (6, 7), (9, 14)])
def test_it_is_that_of_the_dense_matrix(T: int, s: int) -> None:
    diagonal, below, whole = blocks_of(T, s)
    factor = ChainFactor.of(diagonal, below)
    L, inverse = np.linalg.cholesky(whole), np.linalg.inv(whole)
    assert factor.log_det == pytest.approx(np.linalg.slogdet(whole)[1])
    B = np.random.default_rng(1).normal(size=(T, s, 4))
    half = factor.half(factor.inverse @ B)
    np.testing.assert_allclose(half.reshape(T * s, 4), np.linalg.solve(L, B.reshape(T * s, 4)), atol=1e-9)
    np.testing.assert_allclose(factor.whole(half).reshape(T * s, 4), inverse @ B.reshape(T * s, 4), atol=1e-9)
    by_block = inverse.reshape(T, s, T, s)
    own, beside = factor.inverse_blocks()
    at = np.arange(T)
    np.testing.assert_allclose(own, by_block[at, :, at], atol=1e-9)
    np.testing.assert_allclose(beside, by_block[at[1:], :, at[:-1]], atol=1e-9)


def test_an_indefinite_one_is_refused() -> None:
    diagonal, below, _ = blocks_of(4, 3)
    diagonal[2] = -np.eye(3)
    with pytest.raises(np.linalg.LinAlgError):
        ChainFactor.of(diagonal, below)


def information(targets: int, sensors: int, scales: bool, chance: np.random.Generator) -> np.ndarray:
    """Every sensor sees every target; each target may have a scale of its own."""
    width = 7 if scales else 6
    size = width * targets + 6 * sensors
    found = np.zeros((size, size))
    for i in range(targets):
        for j in range(sensors):
            own = np.r_[width * i : width * (i + 1), width * targets + 6 * j : width * targets + 6 * (j + 1)]
            J = chance.normal(size=(20, len(own)))
            found[np.ix_(own, own)] += J.T @ J
    return found


@pytest.mark.parametrize(
    ("targets", "sensors", "scales"), [(40, 1, False), (30, 2, True), (3, 40, False), (2, 2, True)]
)
def test_an_inverse_is_that_of_the_dense_matrix(targets: int, sensors: int, scales: bool) -> None:
    matrix = information(targets, sensors, scales, np.random.default_rng(0))
    order = EliminationOrder.of(matrix)
    inverse, log_det = order.inverse(matrix)
    np.testing.assert_allclose(inverse, np.linalg.inv(matrix), atol=1e-12 * np.abs(inverse).max())
    assert log_det == pytest.approx(np.linalg.slogdet(matrix)[1], rel=1e-12)
    assert order.blocks.shape == ((0, 1) if len(matrix) <= SMALL else (max(targets, sensors), 7 if scales else 6))


def test_a_dense_matrix_is_inverted_as_a_whole_and_an_indefinite_one_refused() -> None:
    J = np.random.default_rng(2).normal(size=(200, 150))
    order = EliminationOrder.of(J.T @ J)
    assert order.blocks.size == 0
    np.testing.assert_allclose(order.inverse(J.T @ J)[0], np.linalg.inv(J.T @ J), atol=1e-12)
    with pytest.raises(np.linalg.LinAlgError):
        order.inverse(J.T @ J - 100.0 * np.eye(150))
    star = information(40, 1, False, np.random.default_rng(0))
    order = EliminationOrder.of(star)
    star[5, 5] = -1.0
    with pytest.raises(np.linalg.LinAlgError):
        order.inverse(star)


def test_the_joint_covariance_of_many_frames_is_the_inverse_and_finds_what_nothing_determines() -> None:
    unknowns = tuple(Unknown(UnknownKind.FRAME, f"frame_{k}") for k in range(41))
    matrix = information(40, 1, False, np.random.default_rng(3))
    unit = np.linspace(0.5, 2.0, len(matrix))
    none = np.zeros((len(matrix), 0))
    found = JointCovariance.of(unknowns, matrix, none, unit)
    assert found.free.shape[1] == 0
    np.testing.assert_allclose(found.finite, np.linalg.inv(matrix), atol=1e-12 * np.abs(found.finite).max())
    np.testing.assert_allclose(found.covariance_of(found.selector(unknowns[3:5])), found.finite[18:30, 18:30])
    matrix[60], matrix[:, 60] = 0.0, 0.0
    assert JointCovariance.of(unknowns, matrix, none, unit).free.shape[1] == 1
