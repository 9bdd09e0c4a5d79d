"""The answer that is handed on: its poses, noise, names and graph."""

from __future__ import annotations

import warnings
from dataclasses import replace

import gtsam
import numpy as np
import pytest
from noisy_rows import problem_of
from settled_models import SIGMA, settled_at, task_of

import gtsam_rwhec as rw
from gtsam_rwhec.errors import NotConvergedWarning
from gtsam_rwhec.fitting.fit_options import Component, RefineOptions, Walk
from gtsam_rwhec.fitting.joint_covariance import JointCovariance
from gtsam_rwhec.fitting.noise_graph import change_between, refined_of
from gtsam_rwhec.fitting.noise_search import Settled, Task, moved
from gtsam_rwhec.fitting.refined import Refined

C = Component


def settled(scale: str = "per_target") -> tuple[Task, Settled, rw.Solution]:
    problem = problem_of(2, 1, 20, scale=scale)
    solution = rw.solve(problem)
    task = task_of(problem, solution)
    return task, settled_at(task, solution, "targetcarrier", Walk(1.0, "sensor"), systematic=True), solution


def refined(task: Task, found: Settled, solution: rw.Solution, options: RefineOptions | None = None) -> Refined:
    basis = found.model.basis
    joint: JointCovariance = replace(task.layout, finite=basis @ found.model.evaluate(SIGMA).covariance @ basis.T)
    inliers = {pair: np.ones(20, dtype=bool) for pair in task.problem.pairs}
    return refined_of(task, found, joint, 17.0, inliers, solution, options or RefineOptions())


def test_it_is_the_graphs_optimum() -> None:
    task, found, solution = settled()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        result = refined(task, found, solution)
    assert result.cost == pytest.approx(result.graph.error(result.values), rel=1e-12)
    assert result.cost < result.initial_cost
    for name, pose in (result.X | result.Y).items():
        assert pose.equals(result.values.atPose3(result.keys[name]), 0.0)
        assert pose.equals((found.state.X | found.state.Y)[name], 1e-5)
    assert result.scale == {
        name: result.values.atVector(result.keys[f"scale:{name}"])[0] for name in ("tag_0", "tag_1")
    }
    assert "drift:19" in result.keys
    assert "systematic" in result.keys
    gradient = result.graph.linearize(result.values).gradientAtZero()
    assert max(np.abs(gradient.at(key)).max() for key in result.keys.values()) < 1e-3
    assert result.moved["tag_0"].translation_mm > 0.0
    assert result.inlier_counts == {pair: (20, 20) for pair in task.problem.pairs}
    assert result.noise_source == "estimated"
    assert result.degrees_of_freedom == 17.0


def test_the_graphs_marginals_are_the_covariance() -> None:
    """What a user gets of the graph by GTSAM alone."""
    result = refined(*settled())
    marginals = gtsam.Marginals(result.graph, result.values)
    for name in ("tag_0", "tag_1", "cam_0"):
        size = np.sqrt(np.diagonal(result.covariance(name)))
        off = marginals.marginalCovariance(result.keys[name]) - result.covariance(name)
        assert np.abs(off / size[:, None] / size).max() < 1e-3


def test_noise_of_pairs_is_that_of_b() -> None:
    task, found, solution = settled()
    for noise in refined(task, found, solution).noise.values():
        # without weights B's covariance is that of kappa = 1: 1 / sqrt(2) rad, times the component
        assert noise.rotation_rad == pytest.approx(SIGMA[C.ROTATION] / np.sqrt(2.0))
        # depth is along one of three axes
        assert noise.translation_m == pytest.approx(np.sqrt(SIGMA[C.TRANSLATION] ** 2 + SIGMA[C.DEPTH] ** 2 / 3.0))
        assert noise.degrees_of_freedom == (17.0, 17.0)


def test_change_between_undoes_moved() -> None:
    task, found, _ = settled()
    change = 0.05 * np.random.default_rng(0).normal(size=len(task.layout.unit))
    after = moved(found.state, task.variables, task.layout, change)
    np.testing.assert_allclose(change_between(task, found.state, after), change, atol=1e-12)


def test_an_optimum_elsewhere_is_said() -> None:
    """A model about another estimate than the graph's."""
    task, found, solution = settled()
    change = np.zeros(len(task.layout.unit))
    change[:3] = 0.05
    wrong = replace(found, state=moved(found.state, task.variables, task.layout, change))
    with pytest.warns(NotConvergedWarning, match=r"the graph's optimum is [\d.]+ standard deviations from that of the"):
        refined(task, wrong, solution)


def test_too_few_iterations_are_said() -> None:
    with pytest.warns(NotConvergedWarning, match="GTSAM stopped after 1 iterations without converging"):
        refined(*settled(), RefineOptions(max_iterations=1))
