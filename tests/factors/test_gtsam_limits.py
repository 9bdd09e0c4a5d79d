"""The limits of GTSAM 4.3 with these factors, and the remedies, as factors/README.md lists them."""

from __future__ import annotations

import pickle

import gtsam
import numpy as np
import pytest
import rwhec_factors
from gtsam.symbol_shorthand import S, Y
from places import REPOSITORY
from rwhec_factors import (
    direction_prior_factor,
    hand_eye_factor,
    pose_prior_factor,
    position_prior_factor,
    rotation_prior_factor,
)

NOISE = gtsam.noiseModel.Isotropic.Sigma(6, 0.01)
MOUNTING = gtsam.Pose3(gtsam.Rot3.RzRyRx(0.3, -0.2, 1.0), np.array([0.1, -0.05, 0.4]))


def problem(
    outlier: bool = False, noise: gtsam.noiseModel.Base = NOISE
) -> tuple[gtsam.NonlinearFactorGraph, gtsam.Values]:
    generator = np.random.default_rng(0)
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    for i in range(10):
        A = gtsam.Pose3.Expmap(generator.standard_normal(6))
        B = MOUNTING.inverse().compose(A).compose(MOUNTING)
        if outlier and i == 0:
            B = B.compose(gtsam.Pose3.Expmap(np.full(6, 0.7)))
        graph.add(hand_eye_factor(Y(0), A, B, noise))
    values.insert(Y(0), MOUNTING.compose(gtsam.Pose3.Expmap(np.full(6, 0.05))))
    return graph, values


def test_gtsams_gnc_refuses_the_factors_and_a_robust_loss_does_not() -> None:
    graph, values = problem(outlier=True)
    with pytest.raises(RuntimeError, match="clone"):
        gtsam.GncLMOptimizer(graph, values, gtsam.GncLMParams()).optimize()
    loss = gtsam.noiseModel.Robust.Create(gtsam.noiseModel.mEstimator.GemanMcClure.Create(10.0), NOISE)
    result = gtsam.LevenbergMarquardtOptimizer(*problem(outlier=True, noise=loss)).optimize()
    assert result.atPose3(Y(0)).equals(MOUNTING, 1e-3)


def test_clone_and_rekey_throw_and_a_copied_graph_shares_its_factors() -> None:
    graph, values = problem()
    for refused in (graph.clone, graph.at(0).clone, lambda: graph.at(0).rekey([Y(5)])):
        with pytest.raises(RuntimeError, match="clone"):
            refused()
    assert gtsam.NonlinearFactorGraph(graph).error(values) == graph.error(values)


def test_factors_cannot_be_pickled_and_a_frozen_linearisation_can() -> None:
    graph, values = problem()
    with pytest.raises(TypeError, match="pickle"):
        pickle.dumps(graph.at(0))
    with pytest.raises(RuntimeError, match="unregistered class"):
        pickle.dumps(graph)
    with pytest.raises(RuntimeError, match="unregistered class"):
        graph.serialize()
    answer = gtsam.LevenbergMarquardtOptimizer(graph, values).optimize()
    frozen = gtsam.LinearContainerFactor.ConvertLinearGraph(graph.linearize(answer), answer)
    restored = pickle.loads(pickle.dumps(frozen))
    assert restored.size() == graph.size()
    moved = gtsam.Values()
    moved.insert(Y(0), answer.atPose3(Y(0)).retract(np.full(6, 1e-3)))
    assert restored.error(moved) == pytest.approx(graph.error(moved), rel=0.05)
    assert restored.clone().size() == graph.size()


def test_values_with_a_float_cannot_be_pickled_and_with_a_one_vector_can() -> None:
    values = gtsam.Values()
    values.insert(S(0), 1.5)
    with pytest.raises(RuntimeError, match="unregistered class"):
        pickle.dumps(values)
    values = gtsam.Values()
    values.insert(S(0), np.array([1.5]))
    values.insert(Y(0), MOUNTING)
    assert pickle.loads(pickle.dumps(values)).equals(values, 1e-12)


def test_equals_does_not_compare_measurements() -> None:
    """Two factors with other measurements are equal to GTSAM when keys and noise are."""
    graph, _ = problem()
    assert graph.at(0).equals(graph.at(1), 1e-9)


def test_gtsams_converter_turns_anisotropic_noise_into_unit_and_ours_refuse() -> None:
    sigmas = np.array([0.1, 0.2, 0.3, 1.0, 1.0, 1.0])
    converted = gtsam.ConvertNoiseModel(gtsam.noiseModel.Diagonal.Sigmas(sigmas), 9)
    np.testing.assert_array_equal(converted.sigmas(), np.ones(9))
    theirs = gtsam.FrobeniusPriorRot3(0, np.eye(3), gtsam.noiseModel.Diagonal.Sigmas(sigmas[:3]))
    assert theirs.noiseModel().isUnit()
    with pytest.raises(ValueError, match="anisotropic"):
        pose_prior_factor(Y(0), MOUNTING, gtsam.noiseModel.Diagonal.Sigmas(sigmas), residual="chordal")


def prior_graph(sigmas: np.ndarray) -> tuple[gtsam.NonlinearFactorGraph, gtsam.Values]:
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    graph.add(pose_prior_factor(Y(0), MOUNTING, gtsam.noiseModel.Diagonal.Sigmas(sigmas)))
    values.insert(Y(0), MOUNTING)
    return graph, values


@pytest.mark.parametrize("free", range(6))
def test_marginals_return_huge_variances_silently_when_nearly_singular(free: int) -> None:
    sigmas = np.full(6, 0.01)
    sigmas[free] = 1e9
    covariance = gtsam.Marginals(*prior_graph(sigmas)).marginalCovariance(Y(0))
    assert covariance[free, free] == pytest.approx(1e18)


def test_marginals_raise_when_singular_and_the_hessian_names_the_direction() -> None:
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    values.insert(Y(0), MOUNTING)
    axis = np.array([1.0, 2.0, -1.0]) / np.sqrt(6.0)
    graph.add(direction_prior_factor(Y(0), axis, MOUNTING.rotation().rotate(axis), 0.01))
    graph.add(position_prior_factor(Y(0), MOUNTING.translation(), gtsam.noiseModel.Isotropic.Sigma(3, 0.01)))
    with pytest.raises(RuntimeError, match="Indeterminate"):
        gtsam.Marginals(graph, values)
    weak = gtsam.NonlinearFactorGraph(graph)
    weak.add(rotation_prior_factor(Y(0), MOUNTING.rotation(), gtsam.noiseModel.Isotropic.Sigma(3, 1e4)))
    with pytest.raises(RuntimeError, match="Indeterminate"):  # determined by now, to 1e4 rad
        gtsam.Marginals(weak, values)
    eigenvalues, eigenvectors = np.linalg.eigh(graph.linearize(values).hessian()[0])
    assert eigenvalues[0] < 1e-9 * eigenvalues[1]
    np.testing.assert_allclose(np.abs(eigenvectors[:, 0]), np.abs(np.r_[axis, 0.0, 0.0, 0.0]), atol=1e-6)


def test_an_error_of_a_factor_comes_out_of_the_optimiser_as_it_is() -> None:
    graph, _ = problem()
    for optimiser in (gtsam.LevenbergMarquardtOptimizer, gtsam.GaussNewtonOptimizer, gtsam.DoglegOptimizer):
        with pytest.raises(KeyError, match="y0 is not in the values"):
            graph.error(gtsam.Values())
        empty = gtsam.Values()
        empty.insert(Y(0), np.zeros(1))
        with pytest.raises(TypeError, match=r"y0 should be .*Pose3"):
            optimiser(graph, empty).optimize()


def test_optimisers_copy_the_values_for_each_factor_and_linearize_does_not() -> None:
    seen: list[gtsam.Values] = []

    def error(factor: gtsam.CustomFactor, values: gtsam.Values, jacobians: list[np.ndarray] | None) -> np.ndarray:
        seen.append(values)
        if jacobians is not None:
            jacobians[0] = np.eye(1)
        return values.atVector(0)

    graph, start = gtsam.NonlinearFactorGraph(), gtsam.Values()
    start.insert(0, np.ones(1))
    for _ in range(2):
        graph.add(gtsam.CustomFactor(gtsam.noiseModel.Unit.Create(1), [0], error))
    graph.linearize(start)
    assert [values is start for values in seen] == [True, True]
    seen.clear()
    gtsam.GaussNewtonOptimizer(graph, start).iterate()
    one, other = seen[-2:]
    assert one.atVector(0) == other.atVector(0)
    assert one is not other


def test_the_readme_lists_every_factor() -> None:
    text = (REPOSITORY / "factors" / "README.md").read_text(encoding="utf-8")
    listed = {name for name in rwhec_factors.__all__ if f"`{name}(" in text}
    assert listed == {name for name in rwhec_factors.__all__ if name.endswith("_factor")}
