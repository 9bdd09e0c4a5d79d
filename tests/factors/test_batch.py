"""Factors with effects: residuals less linear functions of further variables."""

from __future__ import annotations

from typing import Any

import gtsam
import numpy as np
import pytest
from gtsam.symbol_shorthand import D, E, S, U, W, X, Y
from numeric_jacobians import check_jacobians, graph_of
from rwhec_factors import BatchResiduals, robot_world_hand_eye_effects_factor, robot_world_hand_eye_effects_factors, se3
from rwhec_factors.batch import Together, robot_world_hand_eye_batch_factor

N = 5


def problem() -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, dict[int, np.ndarray]]:
    chance = np.random.default_rng(0)
    A, B = (se3.expmap(chance.normal(size=(N, 6))) for _ in range(2))
    root = np.eye(6) + 0.3 * chance.normal(size=(N, 6, 6))
    effects = {U(0): chance.normal(size=(N, 6, 4)), W(3): chance.normal(size=(N, 6, 7))}
    effects[W(3)][2:] = 0.0
    return A, B, chance.normal(size=(N, 6)), root, effects


def point(seed: int = 1) -> gtsam.Values:
    chance = np.random.default_rng(seed)
    values = gtsam.Values()
    for key in (X(0), Y(0)):
        values.insert(key, gtsam.Pose3.Expmap(chance.normal(size=6)))
    for key, size in ((S(0), 1), (D(0), 1), (U(0), 4), (W(3), 7)):
        values.insert(key, chance.uniform(0.3, 1.0, size=size))
    return values


def test_residuals_are_less_the_effects() -> None:
    A, B, twists, root, effects = problem()
    factor = robot_world_hand_eye_effects_factor(
        X(0), Y(0), A, B, root, effects, scale_key=S(0), time_offset_key=D(0), twists=twists
    )
    assert list(factor.keys()) == [X(0), Y(0), D(0), S(0), U(0), W(3)]
    for values in (point(1), point(2)):
        poses = (values.atPose3(key).matrix() for key in (X(0), Y(0)))
        numbers = (values.atVector(key)[0] for key in (S(0), D(0)))
        left = BatchResiduals(A, B, twists).residuals(*poses, *numbers)
        left = left - sum(effect @ values.atVector(key) for key, effect in effects.items())
        expected = np.einsum("nij,nj->ni", root, left).ravel()
        np.testing.assert_allclose(factor.unwhitenedError(values), expected, atol=1e-12)


@pytest.mark.parametrize("options", [{}, {"scale_key": S(0)}, {"scale_key": S(0), "time_offset_key": D(0)}], ids=len)
@pytest.mark.parametrize("sensor", [Y(0), X(0)], ids=["two frames", "motion"])
def test_jacobians_are_the_numeric_ones(sensor: int, options: dict[str, int]) -> None:
    A, B, twists, root, effects = problem()
    if "time_offset_key" in options:
        options = options | {"twists": twists}
    factor = robot_world_hand_eye_effects_factor(X(0), sensor, A, B, root, effects, **options)
    check_jacobians(factor, point(), np.ones(6 * N), atol=1e-6)


def test_parts_are_the_whole() -> None:
    A, B, _, root, effects = problem()
    whole = robot_world_hand_eye_effects_factor(X(0), Y(0), A, B, root, effects, scale_key=S(0))
    cut = [
        (slice(0, 2), {key: effect[:2] for key, effect in effects.items()}),
        (slice(2, N), {U(0): effects[U(0)][2:]}),  # W(3) changes none of these
    ]
    parts = robot_world_hand_eye_effects_factors(X(0), Y(0), A, B, root, cut, scale_key=S(0))
    assert [list(part.keys()) for part in parts] == [[X(0), Y(0), S(0), U(0), W(3)], [X(0), Y(0), S(0), U(0)]]
    ordering = gtsam.Ordering()
    for key in (X(0), Y(0), S(0), U(0), W(3)):
        ordering.push_back(key)
    both = [graph_of(whole), graph_of(*parts)]
    # Each point after another one, with residuals alone first: what is kept of one point is not taken for another.
    for values in (point(1), point(2), point(1)):
        assert both[1].error(values) == pytest.approx(both[0].error(values), rel=1e-12)
        (H, g), (H_parts, g_parts) = (graph.linearize(values).hessian(ordering) for graph in both)
        np.testing.assert_allclose(H_parts, H, rtol=1e-10, atol=1e-9)
        np.testing.assert_allclose(g_parts, g, rtol=1e-10, atol=1e-9)


@pytest.mark.parametrize(
    ("effects", "message"),
    [
        ({E(0): np.zeros((N, 6))}, r"the effect of e0 has shape \(5, 6\); give \(5, 6, m\)"),
        ({E(0): np.zeros((N - 1, 6, 2))}, r"the effect of e0 has shape \(4, 6, 2\)"),
        ({E(0): np.full((N, 6, 2), np.nan)}, "the effect of e0 has entries that are NaN"),
        ({X(0): np.zeros((N, 6, 2))}, "the keys x0, y0, x0 are not all different"),
    ],
    ids=["no columns", "too few", "NaN", "a frame's key"],
)
def test_bad_effects_are_refused(effects: dict[int, np.ndarray], message: str) -> None:
    A, B, _, root, _ = problem()
    with pytest.raises(ValueError, match=message):
        robot_world_hand_eye_effects_factor(X(0), Y(0), A, B, root, effects)


@pytest.mark.parametrize("rows", [slice(3, 3), slice(0, N, 2), slice(7, 9)], ids=str)
def test_parts_without_measurements_are_refused(rows: slice) -> None:
    A, B, _, root, _ = problem()
    with pytest.raises(ValueError, match=r"of 5 measurements holds none, or has a step"):
        robot_world_hand_eye_effects_factors(X(0), Y(0), A, B, root, [(rows, {})])


def test_wrong_coefficients_are_named() -> None:
    A, B, _, root, effects = problem()
    factor = robot_world_hand_eye_effects_factor(X(0), Y(0), A, B, root, effects)
    short, without = point(), point()
    short.update(U(0), np.zeros(3))
    without.erase(W(3))
    with pytest.raises(TypeError, match="u0 should be the coefficients of an effect, a 4-vector; it is a vector of 3"):
        factor.unwhitenedError(short)
    with pytest.raises(KeyError, match="w3 is not in the values"):
        factor.unwhitenedError(without)


def test_pairs_that_are_computed_together_are_what_they_are_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    """Factors of one graph: the same rows, in a single call of the residuals for all pairs and each set of values."""
    rng = np.random.default_rng(4)
    together, alone, joint = Together(), gtsam.NonlinearFactorGraph(), gtsam.NonlinearFactorGraph()
    values = gtsam.Values()
    for k, symbol in enumerate((X(0), X(1), X(2), Y(0))):
        values.insert(symbol, gtsam.Pose3.Expmap(rng.normal(size=6)))
        if k < 3:
            values.insert(S(k), np.array([1.0 + 0.1 * k]))
    for k in range(3):
        A, B = se3.expmap(rng.normal(size=(4 + k, 6))), se3.expmap(rng.normal(size=(4 + k, 6)))
        arguments: dict[str, Any] = {"scale_key": S(k)}
        if k == 1:
            values.insert(D(0), np.array([0.02]))
            arguments |= {"time_offset_key": D(0), "twists": rng.normal(size=(4 + k, 6))}
        alone.add(robot_world_hand_eye_batch_factor(X(k), Y(0), A, B, np.eye(6), **arguments))
        joint.add(robot_world_hand_eye_batch_factor(X(k), Y(0), A, B, np.eye(6), together=together, **arguments))
    sizes: list[int] = []
    linearize = BatchResiduals.linearize

    def counted(batch: BatchResiduals, *at: Any) -> Any:
        sizes.append(len(batch.A))
        return linearize(batch, *at)

    monkeypatch.setattr(BatchResiduals, "linearize", counted)
    assert joint.error(values) == pytest.approx(alone.error(values), rel=1e-12)
    whole = joint.linearize(values)
    assert sizes == [4 + 5 + 6]
    for i in range(3):
        np.testing.assert_allclose(
            whole.at(i).augmentedJacobian(), alone.linearize(values).at(i).augmentedJacobian(), atol=1e-12
        )
    # without the values of one pair the others are computed all the same
    values.erase(X(2))
    some = gtsam.NonlinearFactorGraph()
    some.add(joint.at(0))
    assert np.isfinite(some.error(values))
