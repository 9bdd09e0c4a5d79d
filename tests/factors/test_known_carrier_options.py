"""Factors with a known carrier pose: scale, time offset and the chordal residual; every optimiser; bad input."""

from __future__ import annotations

import gtsam
import numpy as np
import pytest
from gtsam.symbol_shorthand import D, S, X, Y
from numeric_jacobians import check_jacobians, graph_of, values_of
from rwhec_factors import EdgeSummary, edge_summary_factor, robot_world_hand_eye_factor

SIGMAS = np.repeat([0.1, 0.3], 3)
NOISE = gtsam.noiseModel.Diagonal.Sigmas(SIGMAS)
ROWS = {"geodesic": SIGMAS, "chordal": np.repeat([np.sqrt(2.0) * 0.1, 0.3], [9, 3])}
TRUE_X = gtsam.Pose3.Expmap(np.array([0.3, -0.5, 0.2, 0.1, 0.4, -0.3]))
TRUE_Y = gtsam.Pose3.Expmap(np.array([-0.7, 0.2, 0.6, 1.0, -0.2, 0.5]))
TRUE_SCALE = 1.3


def poses(seed: int, size: float = 1.0, count: int = 4) -> list[gtsam.Pose3]:
    generator = np.random.default_rng(seed)
    return [gtsam.Pose3.Expmap(size * generator.standard_normal(6)) for _ in range(count)]


@pytest.mark.parametrize("residual", ["geodesic", "chordal"])
@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("size", [1.0, 1e-6])
def test_jacobians_with_scale_and_time_offset(residual: str, seed: int, size: float) -> None:
    A, B, x, y = poses(seed, size)
    values = values_of({X(0): x, Y(0): y, S(0): 0.7, D(0): 0.05})
    options = {"residual": residual, "time_offset_key": D(0), "twist": [0.3, -0.2, 0.5, 1.0, 0.7, -0.4]}
    for factor in (
        robot_world_hand_eye_factor(X(0), Y(0), A, B, NOISE, residual=residual),
        robot_world_hand_eye_factor(X(0), Y(0), A, B, NOISE, **options),
        robot_world_hand_eye_factor(X(0), Y(0), A, B, NOISE, scale_key=S(0), residual=residual),
        robot_world_hand_eye_factor(X(0), Y(0), A, B, NOISE, scale_key=S(0), **options),
    ):
        check_jacobians(factor, values, ROWS[residual], atol=1e-6)


def test_full_covariance_is_the_mahalanobis_distance_of_b() -> None:
    A, _, x, y = poses(1)
    generator = np.random.default_rng(0)
    root = generator.standard_normal((6, 6))
    covariance = 1e-4 * (root @ root.T + np.eye(6))
    xi = 0.01 * generator.standard_normal(6)
    B = y.inverse().compose(A).compose(x).compose(gtsam.Pose3.Expmap(-xi))
    factor = robot_world_hand_eye_factor(X(0), Y(0), A, B, gtsam.noiseModel.Gaussian.Covariance(covariance))
    expected = 0.5 * xi @ np.linalg.solve(covariance, xi)
    assert factor.error(values_of({X(0): x, Y(0): y})) == pytest.approx(expected, rel=1e-9)


def problem(kind: str) -> tuple[list[gtsam.CustomFactor], gtsam.Values]:
    """Factors of noiseless measurements, and a start off the truth."""
    carriers = poses(3, 0.6, 12)
    measured = []
    for A in carriers:
        P = TRUE_Y.inverse().compose(A).compose(TRUE_X)
        measured.append(gtsam.Pose3(P.rotation(), TRUE_SCALE * P.translation()))
    if kind == "summary":
        stacks = [np.array([T.matrix() for T in stack]) for stack in (carriers, measured)]
        factors = [
            edge_summary_factor(X(0), Y(0), EdgeSummary.of(*(s[part] for s in stacks), 0.3, 50.0), scale_key=S(0))
            for part in (slice(0, 6), slice(6, 12))
        ]
    else:
        noise, residual = NOISE, kind
        if kind == "robust":
            noise = gtsam.noiseModel.Robust.Create(gtsam.noiseModel.mEstimator.Cauchy.Create(1.0), NOISE)
            residual = "geodesic"
            measured[4] = measured[4].compose(gtsam.Pose3.Expmap(np.full(6, 1.0)))  # a gross outlier
        factors = [
            robot_world_hand_eye_factor(X(0), Y(0), A, B, noise, scale_key=S(0), residual=residual)
            for A, B in zip(carriers, measured, strict=True)
        ]
    step = 0.05 * np.random.default_rng(7).standard_normal(12)
    return factors, values_of({X(0): TRUE_X.retract(step[:6]), Y(0): TRUE_Y.retract(step[6:]), S(0): 1.2})


@pytest.mark.parametrize("kind", ["geodesic", "chordal", "robust", "summary"])
def test_the_optimum_is_the_truth(kind: str) -> None:
    """Other optimisers, on factors of every kind of carrier: test_optimisers.py."""
    factors, start = problem(kind)
    result = gtsam.LevenbergMarquardtOptimizer(graph_of(*factors), start).optimize()
    tolerance = 0.03 if kind == "robust" else 1e-5
    assert result.atPose3(X(0)).equals(TRUE_X, tolerance)
    assert result.atPose3(Y(0)).equals(TRUE_Y, tolerance)
    assert result.atVector(S(0))[0] == pytest.approx(TRUE_SCALE, abs=tolerance)


@pytest.mark.parametrize(
    "use",
    [
        lambda graph, values: graph.error(values),
        lambda graph, values: graph.linearize(values),
        lambda graph, values: gtsam.LevenbergMarquardtOptimizer(graph, values).optimize(),
        lambda graph, values: gtsam.ISAM2().update(graph, values),
    ],
)
def test_missing_and_wrong_variables_are_named(use: object) -> None:
    A, B, x, y = poses(5)
    graph = graph_of(robot_world_hand_eye_factor(X(0), Y(0), A, B, NOISE, scale_key=S(0)))
    values = values_of({X(0): x, S(0): 1.0})
    values.insert(Y(0), gtsam.Rot3())
    with pytest.raises(TypeError, match=r"y0 should be Y = T_sensorcarrier_sensor, a gtsam\.Pose3"):
        use(graph, values)
    values = values_of({X(0): x, Y(0): y})
    with pytest.raises(KeyError, match=r"s0 is not in the values; it should be the scale .* a 1-vector"):
        graph.error(values)
    values.insert(S(0), np.ones(2))
    with pytest.raises(TypeError, match=r"s0 should be the scale .* it is a vector of 2"):
        use(graph, values)


def test_bad_arguments_are_named_and_refused() -> None:
    A, B, _, _ = poses(6)
    with pytest.raises(TypeError, match=r"A is a ndarray; give a gtsam\.Pose3"):
        robot_world_hand_eye_factor(X(0), Y(0), A.matrix(), B, NOISE)
    with pytest.raises(TypeError, match=r"B is a NoneType; give a gtsam\.Pose3"):
        robot_world_hand_eye_factor(X(0), Y(0), A, None, NOISE)
    with pytest.raises(ValueError, match="B has entries that are NaN"):
        robot_world_hand_eye_factor(X(0), Y(0), A, gtsam.Pose3(gtsam.Rot3(), np.full(3, np.nan)), NOISE)
    with pytest.raises(ValueError, match="residual='log'"):
        robot_world_hand_eye_factor(X(0), Y(0), A, B, NOISE, residual="log")
    with pytest.raises(ValueError, match="needs both"):
        robot_world_hand_eye_factor(X(0), Y(0), A, B, NOISE, time_offset_key=D(0))
    with pytest.raises(ValueError, match=r"give finite numbers of shape \(6,\)"):
        robot_world_hand_eye_factor(X(0), Y(0), A, B, NOISE, time_offset_key=D(0), twist=np.zeros(3))
    with pytest.raises(ValueError, match="x0, y0, y0 are not all different"):
        robot_world_hand_eye_factor(X(0), Y(0), A, B, NOISE, scale_key=Y(0))
