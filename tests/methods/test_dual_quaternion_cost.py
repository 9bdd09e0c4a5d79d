"""."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from simulated import hand_held, poses

from gtsam_rwhec.errors import CountError, NoiseError, OptionError
from gtsam_rwhec.geometry.quaternions import left, right
from gtsam_rwhec.methods import dual_quaternion_cost as cost_module
from gtsam_rwhec.methods.dual_quaternion_cost import from_transforms, motion_moments, residuals, to_transform
from gtsam_rwhec.methods.motions import Motions, cost_of, motions_of, squared_mahalanobis, squared_residuals


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


def test_a_zero_quaternion_is_refused() -> None:
    with pytest.raises((ValueError, ZeroDivisionError)):
        to_transform(np.zeros(4), np.ones(4))


def matrices(motions: Motions) -> tuple[np.ndarray, np.ndarray]:
    """A_i and B_i as the paper writes them, below eq. 6 (motions without half turns)."""
    q_C, dual_C = from_transforms(motions.C)
    q_H, dual_H = from_transforms(motions.H)
    return left(q_C) - right(q_H), left(dual_C) - right(dual_H)


@pytest.fixture(scope="module")
def motions() -> Motions:
    s = hand_held(30, 0, largest_rad=2.5)
    return motions_of(s.C, s.H)


def test_matrices_are_the_papers(motions: Motions) -> None:
    A, B = matrices(motions)
    alpha = 0.7
    cost = cost_of(motions, alpha)
    assert pytest.approx(np.einsum("nji,njk->ik", A, A) + alpha**2 * np.einsum("nji,njk->ik", B, B)) == cost.S
    assert pytest.approx(alpha**2 * np.einsum("nji,njk->ik", A, A)) == cost.M
    assert pytest.approx(alpha**2 * np.einsum("nji,njk->ik", B, A)) == cost.W
    assert pytest.approx(np.linalg.inv(cost.M)) == cost.Z2
    assert pytest.approx(cost.W @ cost.Z2 + cost.Z2 @ cost.W.T) == cost.Z1
    assert pytest.approx(cost.S - cost.W @ cost.Z2 @ cost.W.T, rel=1e-9) == cost.Z0


def test_value_and_residuals(motions: Motions) -> None:
    A, B = matrices(motions)
    rng = np.random.default_rng(1)
    q, q_dual = rng.normal(size=(2, 4))
    e = np.concatenate([A @ q, B @ q + A @ q_dual], axis=1)
    assert pytest.approx(e) == residuals(motions.rows, q, q_dual).T
    expected = (e[:, :4] ** 2).sum() + 0.49 * (e[:, 4:] ** 2).sum()
    assert cost_of(motions, 0.7).value(q, q_dual) == pytest.approx(expected)
    weights = rng.uniform(0, 2, 30)
    assert squared_residuals(motions, q, q_dual, weights) == pytest.approx(
        (weights @ (e[:, :4] ** 2).sum(axis=1), weights @ (e[:, 4:] ** 2).sum(axis=1))
    )
    rotation, translation = squared_residuals(motions, q, q_dual, weights)
    assert cost_of(motions, 0.7, weights).value(q, q_dual) == pytest.approx(rotation + 0.49 * translation)
    L = rng.normal(size=(30, 8, 8))
    covariances = L @ L.transpose(0, 2, 1) + np.eye(8)
    expected = sum(row @ np.linalg.solve(P, row) for row, P in zip(e, covariances, strict=True))
    assert cost_of(motions, covariances=covariances).value(q, q_dual) == pytest.approx(expected)
    assert squared_mahalanobis(motions, q, q_dual, covariances) == pytest.approx(expected)


def test_one_covariance_is_alpha(motions: Motions) -> None:
    by_covariance = cost_of(motions, covariances=np.diag([1.0] * 4 + [4.0] * 4))
    by_alpha = cost_of(motions, 0.5)
    assert pytest.approx(by_alpha.S) == by_covariance.S
    assert pytest.approx(by_alpha.W) == by_covariance.W
    assert pytest.approx(by_alpha.M) == by_covariance.M


def test_blocks_add_up(motions: Motions, monkeypatch: pytest.MonkeyPatch) -> None:
    weights = np.random.default_rng(2).uniform(0, 1, 30)
    covariances = np.diag(np.arange(1.0, 9.0))
    q, q_dual = np.random.default_rng(3).normal(size=(2, 4))

    def figures() -> list[np.ndarray]:
        return [
            motion_moments(motions.rows, weights).BA,
            cost_of(motions, covariances=covariances).S,
            np.array(squared_residuals(motions, q, q_dual, weights)),
        ]

    whole = figures()
    monkeypatch.setattr(cost_module, "BLOCK", 8)
    for a, b in zip(whole, figures(), strict=True):
        assert a == pytest.approx(b, rel=1e-12)


def test_what_cannot_weigh(motions: Motions) -> None:
    with pytest.raises(CountError, match=r"weights have shape \(3,\)"):
        cost_of(motions, weights=np.ones(3))
    with pytest.raises(NoiseError, match="weight 4 is -1"):
        cost_of(motions, weights=np.where(np.arange(30) == 4, -1.0, 1.0))
    with pytest.raises(NoiseError, match="1 of 30 weights are not zero"):
        cost_of(motions, weights=np.eye(30)[0])
    with pytest.raises(CountError, match="covariances have shape"):
        cost_of(motions, covariances=np.eye(6))
    with pytest.raises(NoiseError, match="covariance 0 is not positive definite"):
        cost_of(motions, covariances=np.diag([1.0] * 7 + [0.0]))
    with pytest.raises(NoiseError, match="not finite and symmetric"):
        cost_of(motions, covariances=np.triu(np.ones((8, 8))))
    with pytest.raises(OptionError, match="both given"):
        cost_of(motions, weights=np.ones(30), covariances=np.eye(8))
