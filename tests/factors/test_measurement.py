from __future__ import annotations

import subprocess
import sys

import gtsam
import numpy as np
import pytest
from gtsam.symbol_shorthand import X, Y
from rwhec_factors import robot_world_hand_eye_factor

NOISE = gtsam.noiseModel.Isotropic.Sigma(6, 0.1)


def poses(seed: int, size: float) -> list[gtsam.Pose3]:
    generator = np.random.default_rng(seed)
    return [gtsam.Pose3.Expmap(size * generator.standard_normal(6)) for _ in range(4)]


def numeric_jacobian(factor: gtsam.CustomFactor, values: gtsam.Values, key: int) -> np.ndarray:
    step = 1e-5
    columns = []
    for k in range(6):
        sides = []
        for sign in (1.0, -1.0):
            moved = gtsam.Values(values)
            moved.update(key, values.atPose3(key).retract(sign * step * np.eye(6)[k]))
            sides.append(factor.unwhitenedError(moved))
        columns.append((sides[0] - sides[1]) / (2.0 * step))
    return np.array(columns).T


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("size", [1.0, 1e-6])
def test_jacobians_are_the_numeric_ones(seed: int, size: float) -> None:
    A, B, T_target, T_sensor = poses(seed, size)
    factor = robot_world_hand_eye_factor(X(0), Y(0), A, B, NOISE)
    values = gtsam.Values()
    values.insert(X(0), T_target)
    values.insert(Y(0), T_sensor)
    linear = factor.linearize(values)
    whitened = linear.jacobian()[0] * 0.1
    expected = np.hstack([numeric_jacobian(factor, values, key) for key in list(factor.keys())])
    np.testing.assert_allclose(whitened, expected, atol=1e-7)


def test_residual_is_the_perturbation_of_b() -> None:
    A, _, T_target, T_sensor = poses(1, 1.0)
    xi = np.array([0.02, -0.01, 0.03, 0.1, -0.2, 0.05])
    exact = T_sensor.inverse().compose(A).compose(T_target)
    factor = robot_world_hand_eye_factor(X(0), Y(0), A, exact.compose(gtsam.Pose3.Expmap(-xi)), NOISE)
    values = gtsam.Values()
    values.insert(X(0), T_target)
    values.insert(Y(0), T_sensor)
    np.testing.assert_allclose(factor.unwhitenedError(values), xi, atol=1e-12)


def test_graph_recovers_the_extrinsics() -> None:
    generator = np.random.default_rng(3)
    _, _, T_target, T_sensor = poses(2, 0.7)
    graph = gtsam.NonlinearFactorGraph()
    for _ in range(12):
        A = gtsam.Pose3.Expmap(generator.standard_normal(6))
        B = T_sensor.inverse().compose(A).compose(T_target)
        graph.add(robot_world_hand_eye_factor(X(0), Y(0), A, B, NOISE))
    start = gtsam.Values()
    start.insert(X(0), T_target.retract(0.2 * generator.standard_normal(6)))
    start.insert(Y(0), T_sensor.retract(0.2 * generator.standard_normal(6)))
    result = gtsam.LevenbergMarquardtOptimizer(graph, start).optimize()
    assert result.atPose3(X(0)).equals(T_target, 1e-6)
    assert result.atPose3(Y(0)).equals(T_sensor, 1e-6)


def test_wrong_noise_and_equal_keys_are_named() -> None:
    A, B, _, _ = poses(4, 1.0)
    with pytest.raises(ValueError, match="dimension 3"):
        robot_world_hand_eye_factor(X(0), Y(0), A, B, gtsam.noiseModel.Isotropic.Sigma(3, 1.0))
    with pytest.raises(ValueError, match="x0"):
        robot_world_hand_eye_factor(X(0), X(0), A, B, NOISE)


def test_importing_the_factors_imports_nothing_else_of_ours() -> None:
    code = (
        "import sys, rwhec_factors; print([m for m in sys.modules if m.startswith(('gtsam_rwhec', 'scipy', 'rich'))])"
    )
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert run.stdout.strip() == "[]"
