"""The graph has the model's information and optimum, whatever is in the model; and the answer that is handed on."""

from __future__ import annotations

import warnings
from dataclasses import dataclass, replace

import gtsam
import numpy as np
import pytest
from noisy_rows import SIGMA, problem_of, random_poses, settled_at, task_of
from rwhec_factors import se3

import gtsam_rwhec as rw
from gtsam_rwhec.errors import NotConvergedWarning, NotUniqueWarning
from gtsam_rwhec.fitting import noise_graph as graphs
from gtsam_rwhec.fitting.fit_options import About, Component, RefineOptions, Walk
from gtsam_rwhec.fitting.joint_covariance import JointCovariance
from gtsam_rwhec.fitting.noise_graph import graph_of, refined_of
from gtsam_rwhec.fitting.noise_search import Settled, Task, moved
from gtsam_rwhec.fitting.pose_graph import information_of, optimise
from gtsam_rwhec.fitting.refined import FactorGraph, Refined
from gtsam_rwhec.fitting.unknowns import State, UnknownKind

C = Component


@dataclass(frozen=True)
class Case:
    targets: int = 1
    sensors: int = 1
    shared: bool = True
    count: int = 12
    scale: str = "shared"
    walk: Walk | None = None
    systematic: bool = False
    side: About = "targetcarrier"
    priors: bool = False
    fixed: bool = False
    offset: bool = False
    rate: bool = False

    def settled(self) -> tuple[Task, Settled, rw.Solution]:
        if self.offset:
            problem = smooth(self.sensors)
        else:
            problem = problem_of(
                self.targets, self.sensors, self.count, scale=self.scale, shared=self.shared, missing=2
            )
        solution = rw.solve(problem)
        if self.priors:
            off = gtsam.Pose3.Expmap(np.array([0.01, -0.02, 0.01, 0.003, 0.001, -0.002]))
            problem.add_prior("tag_0", solution.X["tag_0"].compose(off), sigma=0.005, kappa=1e4)
            problem.add_prior("cam_0", solution.Y["cam_0"], sigma=0.01)
        if self.fixed:
            problem.fix("cam_0", solution.Y["cam_0"])
        solution = rw.solve(problem)
        rates = {"cam_0": 700_000_000} if self.rate else {}
        task = task_of(problem, solution, ("cam_0",) if self.offset else (), rates)
        found = settled_at(task, solution, self.side, self.walk, systematic=self.systematic)
        return task, found, solution


CASES = {
    "plain": Case(),
    "drift": Case(walk=Walk(1.0, "sensor")),
    "correlated errors": Case(walk=Walk(0.8, "target"), side="sensorcarrier"),
    "systematic": Case(systematic=True),
    "shared carriers": Case(2, 2),
    "shared carriers, all effects": Case(2, 2, walk=Walk(1.0, "sensor"), systematic=True, side="sensorcarrier"),
    "one track after the other": Case(2, 1, shared=False, walk=Walk(1.0, "sensor"), systematic=True),
    "priors": Case(priors=True, walk=Walk(1.0, "sensor"), systematic=True),
    "a fixed frame": Case(2, 1, fixed=True, walk=Walk(1.0, "sensor")),
    "priors and a fixed frame": Case(2, 2, fixed=True, priors=True, systematic=True),
    "a scale for each target": Case(2, 1, scale="per_target", walk=Walk(1.0, "sensor"), systematic=True),
    "known scale": Case(scale="known", walk=Walk(1.0, "target")),
    "a time offset": Case(1, 2, offset=True, walk=Walk(0.9, "sensor")),
    "a clock's rate": Case(1, 2, offset=True, rate=True, walk=Walk(0.9, "sensor")),
}


def smooth(sensors: int) -> rw.Problem:
    """Along a path without jumps, on which a clock's offset can be found: cam_0's is 10 ms."""
    chance = np.random.default_rng(4)
    phase, rate = chance.uniform(0.0, 6.0, 6), chance.uniform(0.5, 1.2, 6)
    t = np.arange(40) * 0.05

    def path(t: np.ndarray) -> np.ndarray:
        return se3.expmap(0.6 * np.sin(rate * t[:, None] + phase))

    X, *Y = random_poses(chance, 1 + sensors)
    problem = rw.Problem()
    for j in range(sensors):
        B = np.linalg.inv(Y[j]) @ path(t + 0.01 * (j == 0)) @ X @ random_poses(chance, len(t), 0.003, 0.002)
        problem.add("tag_0", f"cam_{j}", path(t), B, stamps_ns=np.round(t * 1e9).astype(np.int64))
    return problem


def made_of(task: Task, found: Settled) -> FactorGraph:
    return graph_of(found.model, SIGMA, task.data, task.variables, found.state, task.problem)


def without_constraints(graph: gtsam.NonlinearFactorGraph) -> gtsam.NonlinearFactorGraph:
    free = gtsam.NonlinearFactorGraph()
    for factor in map(graph.at, range(graph.size())):
        if not isinstance(factor, gtsam.NonlinearEqualityPose3):
            free.add(factor)
    return free


def distance(task: Task, found: Settled, sigma: dict[C, float], state: State) -> float:
    """The largest difference of an estimate from the linear model's optimum, in its standard deviations."""
    estimate, basis = found.model.evaluate(sigma), found.model.basis
    optimum = moved(found.state, task.variables, task.layout, basis @ estimate.step)
    change = np.zeros(len(task.layout.unit))
    poses, others = optimum.X | optimum.Y, state.X | state.Y
    for unknown, place in task.layout.slots.items():
        if unknown.owner in poses and unknown.kind is UnknownKind.FRAME:
            change[place] = gtsam.Pose3.Logmap(poses[unknown.owner].between(others[unknown.owner]))
        elif unknown.kind is UnknownKind.SCALE:
            change[place] = state.scales[unknown] - optimum.scales[unknown]
        elif unknown.kind is UnknownKind.TIME_OFFSET:
            change[place] = state.offsets_s[unknown.owner] - optimum.offsets_s[unknown.owner]
    away = np.linalg.lstsq(basis, change, rcond=None)[0]
    return float(np.abs(away / np.sqrt(np.diagonal(estimate.covariance))).max())


@pytest.mark.parametrize("case", CASES.values(), ids=CASES)
def test_information_and_optimum_are_the_models(case: Case) -> None:
    task, found, _ = case.settled()
    made = made_of(task, found)
    assert not task.free_directions
    information = information_of(without_constraints(made.graph), made.values, task.variables)
    estimate, basis = found.model.evaluate(SIGMA), found.model.basis
    rates = [place.start for unknown, place in task.layout.slots.items() if unknown.kind is UnknownKind.CLOCK_RATE]
    others = np.delete(np.arange(len(basis)), rates)
    expected = np.linalg.inv(estimate.covariance[np.ix_(others, others)])
    size = np.sqrt(np.diagonal(expected))
    difference = (basis.T @ information @ basis)[np.ix_(others, others)] - expected
    assert np.abs(difference / size[:, None] / size).max() < 1e-6

    optimum = optimise(made.graph, made.values, 100)
    state = task.variables.state(optimum.values)
    assert distance(task, found, SIGMA, state) < 1e-3
    by_gtsam = gtsam.LevenbergMarquardtOptimizer(made.graph, made.values)
    by_gtsam.optimize()
    assert optimum.cost == pytest.approx(by_gtsam.error(), rel=1e-7)
    for name, T in task.problem.fixed.items():
        np.testing.assert_allclose((state.X | state.Y)[name].matrix(), T, atol=1e-12)


def test_effects_have_names() -> None:
    task, found, _ = Case(
        2, 1, walk=Walk(1.0, "sensor"), systematic=True
    ).settled()  # two poses have one measurement only
    made = made_of(task, found)
    names = {f"drift:{i}" for i in range(12)} | {f"carrier:{i}" for i in range(10)} | {"systematic"}
    assert set(made.keys) == names
    effects = set(made.values.keys()) - set(task.variables.keys.values())
    assert effects == set(made.keys.values())
    assert made.values.atVector(made.keys["drift:3"]).shape == (14,)
    assert made.values.atVector(made.keys["systematic"]).shape == (6 * found.model.features.shape[1],)


def test_only_the_effects_of_the_model_are_in_the_graph() -> None:
    task, found, _ = Case(2, 1, systematic=True).settled()
    quiet = SIGMA | dict.fromkeys((C.CARRIER_ROTATION, C.CARRIER_TRANSLATION), 0.0)
    made = graph_of(found.model, quiet, task.data, task.variables, found.state, task.problem)
    assert set(made.keys) == {"systematic"}
    quiet |= dict.fromkeys((C.SYSTEMATIC_ROTATION, C.SYSTEMATIC_TRANSLATION), 0.0)
    made = graph_of(found.model, quiet, task.data, task.variables, found.state, task.problem)
    assert made.keys == {}
    assert made.graph.size() == 2  # one factor for each pair


def test_factors_hold_few_instants(monkeypatch: pytest.MonkeyPatch) -> None:
    task, found, _ = Case(count=25, walk=Walk(1.0, "sensor")).settled()

    def largest() -> int:
        graph = made_of(task, found).graph
        factors = [graph.at(i) for i in range(graph.size())]
        return max(len(factor.keys()) for factor in factors if isinstance(factor, gtsam.CustomFactor))

    assert largest() == 3 + 10  # X, Y, the scale and ten instants
    monkeypatch.setattr(graphs, "COLUMNS", 3 * 7)
    assert largest() == 3 + 3


def test_the_values_are_the_drift_that_was_put_in() -> None:
    chance = np.random.default_rng(5)
    count, phi = 40, 0.8
    unit = np.repeat([0.02, 0.01], 3)
    drift = chance.normal(size=(count, 6))
    for i in range(1, count):
        drift[i] = phi * drift[i - 1] + np.sqrt(1.0 - phi**2) * drift[i]
    still = rw.Problem()
    still.add("tag_0", "cam_0", *drifting(count, drift * unit, chance), stamps_ns=np.arange(count) * 100_000_000)
    solution = rw.solve(still)
    task = task_of(still, solution)
    found = settled_at(task, solution, "targetcarrier", Walk(phi, "target"), systematic=False)
    sigma = dict.fromkeys(C, 0.0)
    sigma |= {C.ROTATION: 1e-3, C.TRANSLATION: 5e-4, C.DRIFT_ROTATION: 0.02, C.DRIFT_TRANSLATION: 0.01}
    made = graph_of(found.model, sigma, task.data, task.variables, found.state, still)
    values = optimise(made.graph, made.values, 100).values
    states = np.array([values.atVector(made.keys[f"drift:{i}"])[:6] for i in range(count)])
    # X and Y take up what is alike at all instants.
    away = (states - states.mean(axis=0)) - (drift - drift.mean(axis=0))
    assert np.sqrt((away**2).mean()) < 0.3


def drifting(count: int, drift: np.ndarray, chance: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """A, and B with errors of a drift (N, 6) that the residual has, and a little noise."""
    A, XY, noise = random_poses(chance, count), random_poses(chance, 2), random_poses(chance, count, 1e-3, 5e-4)
    return A, np.linalg.inv(XY[1]) @ A @ XY[0] @ se3.expmap(-drift) @ noise


def test_free_directions_stay_where_they_were() -> None:
    """A robot that turns about one axis only: the heights are free, and the optimum does not run away."""
    chance = np.random.default_rng(2)
    turns = np.zeros((15, 6))
    turns[:, 2] = chance.uniform(-2.0, 2.0, 15)
    turns[:, 3:5] = chance.normal(size=(15, 2))
    A = np.array([gtsam.Pose3.Expmap(turn).matrix() for turn in turns])
    X, Y = (gtsam.Pose3.Expmap(chance.normal(size=6)).matrix() for _ in range(2))
    noise = np.array([gtsam.Pose3.Expmap(0.003 * chance.normal(size=6)).matrix() for _ in range(15)])
    problem = rw.Problem()
    problem.add("tag_0", "cam_0", A, np.linalg.inv(Y) @ A @ X @ noise, stamps_ns=np.arange(15) * 100_000_000)
    with pytest.warns(NotUniqueWarning):
        solution = rw.solve(problem)
    task = task_of(problem, solution)
    assert task.free_directions
    found = settled_at(task, solution, "targetcarrier", Walk(1.0, "sensor"), systematic=False)
    made = made_of(task, found)
    held = {task.variables.keys[unknown]: unknown.dimension for unknown in task.variables.unknowns}
    state = task.variables.state(optimise(made.graph, made.values, 100, held).values)
    assert distance(task, found, SIGMA, state) < 1e-3
    for name, pose in (found.state.X | found.state.Y).items():
        np.testing.assert_allclose((state.X | state.Y)[name].matrix(), pose.matrix(), atol=1e-5)


def test_a_drift_that_only_turns_is_no_singular_graph() -> None:
    """GTSAM's optimiser fails where the steps of the translation are a thousand times less than the lever's."""
    task, found, _ = Case(count=30, walk=Walk(1.0, "sensor")).settled()
    turning = SIGMA | {C.DRIFT_TRANSLATION: 1e-7}
    made = graph_of(found.model, turning, task.data, task.variables, found.state, task.problem)
    optimum = optimise(made.graph, made.values, 100)
    assert optimum.iterations < 10
    # The step of one hundredth of the lever's costs less than a hundredth of a standard deviation.
    assert distance(task, found, turning, task.variables.state(optimum.values)) < 1e-2


def of_two_targets(scale: str = "per_target") -> tuple[Task, Settled, rw.Solution]:
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
    task, found, solution = of_two_targets()
    with warnings.catch_warnings(action="error"):
        result = refined(task, found, solution)
    assert result.cost == pytest.approx(result.graph.error(result.values), rel=1e-6)
    assert result.cost < result.initial_cost
    for name, pose in (result.X | result.Y).items():
        assert pose.equals(result.values.atPose3(result.keys[name]), 1e-7)
        assert pose.equals((found.state.X | found.state.Y)[name], 1e-5)
    for name in ("tag_0", "tag_1"):
        assert result.scale[name] == pytest.approx(result.values.atVector(result.keys[f"scale:{name}"])[0], rel=1e-7)
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
    result = refined(*of_two_targets())
    marginals = gtsam.Marginals(result.graph, result.values)
    for name in ("tag_0", "tag_1", "cam_0"):
        size = np.sqrt(np.diagonal(result.covariance(name)))
        off = marginals.marginalCovariance(result.keys[name]) - result.covariance(name)
        assert np.abs(off / size[:, None] / size).max() < 1e-3


def test_noise_of_pairs_is_that_of_b() -> None:
    task, found, solution = of_two_targets()
    for noise in refined(task, found, solution).noise.values():
        # without weights B's covariance is that of kappa = 1: 1 / sqrt(2) rad, times the component
        assert noise.rotation_rad == pytest.approx(SIGMA[C.ROTATION] / np.sqrt(2.0))
        # depth is along one of three axes
        assert noise.translation_m == pytest.approx(np.sqrt(SIGMA[C.TRANSLATION] ** 2 + SIGMA[C.DEPTH] ** 2 / 3.0))
        assert noise.degrees_of_freedom == (17.0, 17.0)


def away(task: Task, found: Settled, rad: float) -> Settled:
    """What was found, with the first frame turned."""
    there = moved(found.state, task.variables, task.layout, np.r_[np.full(3, rad), np.zeros(len(task.layout.unit) - 3)])
    return replace(found, state=there, model=task.model_like(found.model, there))


def test_the_optimum_is_found_from_elsewhere() -> None:
    task, found, solution = of_two_targets()
    result = refined(task, away(task, found, 0.05), solution)
    for name, pose in (result.X | result.Y).items():
        assert pose.equals(result.values.atPose3(result.keys[name]), 1e-5)


def test_steps_that_do_not_end_are_said() -> None:
    task, found, solution = of_two_targets()
    with pytest.warns(NotConvergedWarning, match="standard deviations"):
        refined(task, away(task, found, 0.5), solution, RefineOptions(max_iterations=1))


def test_steps_that_become_no_shorter_end(monkeypatch: pytest.MonkeyPatch) -> None:
    task, found, solution = of_two_targets()
    found = away(task, found, 0.05)
    monkeypatch.setattr(Task, "model_like", lambda *_: found.model)  # so each step is as long as the first
    with pytest.warns(NotConvergedWarning, match="standard deviations"):
        result = refined(task, found, solution)
    assert result.iterations == graphs.IN_A_CIRCLE
