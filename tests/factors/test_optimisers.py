"""One graph of every factor that takes poses from the graph, in each of GTSAM's optimisers."""

from __future__ import annotations

from collections.abc import Callable

import gtsam
import numpy as np
import pytest
from gtsam.symbol_shorthand import P, S, X, Y
from rwhec_factors import (
    dual_quaternion_prior_factor,
    log_scale_prior_factor,
    pose_hand_eye_factor,
    pose_prior_factor,
    pose_robot_world_hand_eye_factor,
    two_pose_robot_world_hand_eye_factor,
)

COUNT = 14
TIGHT = gtsam.noiseModel.Isotropic.Sigma(6, 1e-3)
NOISE = gtsam.noiseModel.Diagonal.Sigmas(np.repeat([0.01, 0.02], 3))
TARGET = gtsam.Pose3.Expmap(np.array([0.5, -0.4, 0.9, 1.0, 2.0, 0.5]))  # in the world
SENSORS = [
    gtsam.Pose3.Expmap(np.array([1.0, 0.3, -0.5, 0.1, -0.2, 0.3])),
    gtsam.Pose3.Expmap(np.array([-0.4, 0.8, 0.6, 0.3, 0.2, -0.1])),
]
BEACON = gtsam.Pose3.Expmap(np.array([0.2, 0.1, -0.3, 0.4, 0.5, 0.6]))  # a target on another robot
SCALE = 0.8


def measured(T: gtsam.Pose3, generator: np.random.Generator, scale: float = 1.0) -> gtsam.Pose3:
    noise = gtsam.Pose3.Expmap(1e-3 * generator.standard_normal(6))
    return gtsam.Pose3(T.rotation(), scale * T.translation()).compose(noise)


def steps(
    loss: gtsam.noiseModel.mEstimator.Base | None = None,
) -> list[tuple[gtsam.NonlinearFactorGraph, gtsam.Values]]:
    """Robot poses P(i) and another robot's P(100 + i), with the measurements at each pose."""
    generator = np.random.default_rng(0)
    noise = NOISE if loss is None else gtsam.noiseModel.Robust.Create(loss, NOISE)
    robots = [gtsam.Pose3.Expmap(generator.standard_normal(6)) for _ in range(COUNT)]
    others = [gtsam.Pose3.Expmap(generator.standard_normal(6)) for _ in range(COUNT)]
    result = []
    for i, (robot, other) in enumerate(zip(robots, others, strict=True)):
        graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        if i == 0:
            graph.add(dual_quaternion_prior_factor(Y(0), SENSORS[0], 1.0, 1.0))
            graph.add(pose_prior_factor(Y(1), SENSORS[1], gtsam.noiseModel.Isotropic.Sigma(6, 1.0)))
            graph.add(pose_prior_factor(X(1), BEACON, gtsam.noiseModel.Isotropic.Sigma(6, 1.0)))
            graph.add(log_scale_prior_factor(S(0), 1.0, 0.5))
            for key, T in ((X(0), TARGET), (X(1), BEACON), (Y(0), SENSORS[0]), (Y(1), SENSORS[1])):
                values.insert(key, T.compose(gtsam.Pose3.Expmap(0.1 * generator.standard_normal(6))))
            values.insert(S(0), np.array([1.0]))
        for key, T in ((P(i), robot), (P(100 + i), other)):
            graph.add(gtsam.PriorFactorPose3(key, T, TIGHT))
            values.insert(key, T)
        seen = robot.compose(SENSORS[0]).between(TARGET)
        wrong = gtsam.Pose3.Expmap(np.full(6, 1.5)) if loss is not None and i == 3 else gtsam.Pose3()
        B = measured(seen, generator).compose(wrong)
        graph.add(pose_robot_world_hand_eye_factor(P(i), X(0), Y(0), B, noise))
        beacon = robot.compose(SENSORS[0]).between(other.compose(BEACON))
        B = measured(beacon, generator)
        graph.add(two_pose_robot_world_hand_eye_factor(P(i), P(100 + i), X(1), Y(0), B, noise, residual="chordal"))
        if i > 0:
            moved = robots[i - 1].compose(SENSORS[1]).between(robot.compose(SENSORS[1]))
            B = measured(moved, generator, SCALE)
            graph.add(pose_hand_eye_factor(P(i - 1), P(i), Y(1), B, noise, scale_key=S(0)))
        result.append((graph, values))
    return result


def whole(loss: gtsam.noiseModel.mEstimator.Base | None = None) -> tuple[gtsam.NonlinearFactorGraph, gtsam.Values]:
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    for more, new in steps(loss):
        graph.push_back(more)
        values.insert(new)
    return graph, values


def check(values: gtsam.Values, within: float = 2e-3) -> None:
    for key, T in ((X(0), TARGET), (X(1), BEACON), (Y(0), SENSORS[0]), (Y(1), SENSORS[1])):
        assert values.atPose3(key).equals(T, within), gtsam.DefaultKeyFormatter(key)
    assert values.atVector(S(0))[0] == pytest.approx(SCALE, abs=within)


Optimise = Callable[[gtsam.NonlinearFactorGraph, gtsam.Values], gtsam.Values]
BATCH: dict[str, Optimise] = {
    "Levenberg-Marquardt": lambda graph, start: gtsam.LevenbergMarquardtOptimizer(graph, start).optimize(),
    "Gauss-Newton": lambda graph, start: gtsam.GaussNewtonOptimizer(graph, start).optimize(),
    "dogleg": lambda graph, start: gtsam.DoglegOptimizer(graph, start).optimize(),
}


@pytest.mark.parametrize("name", BATCH)
def test_batch_optimisers_agree_with_the_truth_and_each_other(name: str) -> None:
    graph, start = whole()
    result = BATCH[name](graph, start)
    check(result)
    reference = BATCH["Levenberg-Marquardt"](graph, start)
    assert graph.error(result) == pytest.approx(graph.error(reference), rel=1e-5)


@pytest.mark.parametrize("dogleg", [False, True], ids=["Gauss-Newton steps", "dogleg steps"])
def test_isam2(dogleg: bool) -> None:
    parameters = gtsam.ISAM2Params()
    parameters.setRelinearizeThreshold(1e-6)
    parameters.relinearizeSkip = 1
    if dogleg:
        parameters.setOptimizationParams(gtsam.ISAM2DoglegParams())
    isam = gtsam.ISAM2(parameters)
    for graph, new in steps():
        isam.update(graph, new)
    for _ in range(10):
        isam.update()
    result = isam.calculateEstimate()
    check(result)
    graph, start = whole()
    batch = BATCH["Levenberg-Marquardt"](graph, start)
    assert graph.error(result) == pytest.approx(graph.error(batch), rel=1e-5)
    marginals = gtsam.Marginals(graph, batch)
    np.testing.assert_allclose(isam.marginalCovariance(Y(1)), marginals.marginalCovariance(Y(1)), rtol=1e-3, atol=1e-9)


def incremental_smoother() -> gtsam.FixedLagSmoother:
    parameters = gtsam.ISAM2Params()
    parameters.relinearizeSkip = 1
    return gtsam.IncrementalFixedLagSmoother(3.5, parameters)


def smoothed(lagged: gtsam.FixedLagSmoother) -> gtsam.Values:
    """The estimate after all steps; the extrinsics keep the last step's time."""
    extrinsics = [X(0), X(1), Y(0), Y(1), S(0)]
    for i, (graph, new) in enumerate(steps()):
        lagged.update(graph, new, {key: float(i) for key in [*list(new.keys()), *extrinsics]})
    for _ in range(5):
        lagged.update(gtsam.NonlinearFactorGraph(), gtsam.Values(), {})
    return lagged.calculateEstimate()


@pytest.mark.parametrize(
    "make", [incremental_smoother, lambda: gtsam.BatchFixedLagSmoother(3.5)], ids=["incremental", "batch"]
)
def test_fixed_lag_smoothers_keep_extrinsics_and_forget_poses(make: Callable[[], gtsam.FixedLagSmoother]) -> None:
    result = smoothed(make())
    # Marginalised at where they were linearised then.
    check(result, within=2e-2)
    assert not result.exists(P(0))
    assert result.exists(P(COUNT - 1))


def test_the_incremental_smoother_keeps_wrong_linearisations_by_default() -> None:
    assert gtsam.ISAM2Params().relinearizeSkip == 10
    result = smoothed(gtsam.IncrementalFixedLagSmoother(3.5))
    with pytest.raises(AssertionError, match="y1"):
        check(result, within=2e-2)


@pytest.mark.parametrize("loss", ["Huber", "Cauchy", "GemanMcClure", "Tukey"])
def test_robust_losses_hold_out_a_gross_outlier(loss: str) -> None:
    robust = getattr(gtsam.noiseModel.mEstimator, loss)
    constant = {"Huber": 1.345, "Cauchy": 2.4, "GemanMcClure": 10.0, "Tukey": 30.0}[loss]
    graph, start = whole(robust.Create(constant))
    check(BATCH["Levenberg-Marquardt"](graph, start), within=1e-2 if loss == "Huber" else 3e-3)


def test_the_same_outlier_harms_without_a_loss() -> None:
    graph, start = whole(gtsam.noiseModel.mEstimator.Null.Create())
    with pytest.raises(AssertionError):
        check(BATCH["Levenberg-Marquardt"](graph, start), within=1e-2)
