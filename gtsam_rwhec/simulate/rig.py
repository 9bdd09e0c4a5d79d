"""Any number of sensors on a moving carrier among any number of targets, with the noise where sensors have it."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import TypeVar

import numpy as np

from gtsam_rwhec.errors import OptionError
from gtsam_rwhec.problem.knowledge import ScaleMode
from gtsam_rwhec.problem.pairs import ByPair, Pair
from gtsam_rwhec.problem.problem import Problem
from gtsam_rwhec.simulate.graphs import Edge, GraphKind, bipartite_edges
from gtsam_rwhec.simulate.motion import Motion, MotionKind, carrier_poses
from gtsam_rwhec.simulate.noise import Noise, Seed, perturb, weights_of
from gtsam_rwhec.simulate.scales import true_scales
from gtsam_rwhec.simulate.simulation import Simulation
from gtsam_rwhec.simulate.transforms import inverse, random_poses

Value = TypeVar("Value")

#: Largest coordinate of a target in the world, and of a sensor on the rig: a room, and a rig that a person can carry.
TARGETS_WITHIN_M = 2.0
SENSORS_WITHIN_M = 0.5
#: Time between two poses of the rig: ten a second.
PERIOD_NS = 100_000_000


def general(
    targets: int,
    sensors: int,
    *,
    seed: Seed,
    graph: GraphKind | Iterable[Edge] = "complete",
    edge_probability: float = 0.3,
    motion: Motion | MotionKind = "general",
    number_of_measurements: int | ByPair[int] = 20,
    noise: Noise | ByPair[Noise] | None = None,
    noise_in_A: Noise | None = None,
    scale: ScaleMode = "known",
    true_scale: float | Mapping[str, float] | None = None,
    known_sizes: Iterable[str] = (),
    odometry: int = 0,
    odometry_noise: Noise | None = None,
    keep_measurements: bool = True,
) -> Simulation:
    """Simulate sensors "sensor0", ... on a moving rig that see targets "target0", ... in a fixed world.

    The carriers are the rig (of the sensors) and the world (of the targets): A = T_rig_world, X = T_world_target,
    Y = T_rig_sensor, and B = T_sensor_target is what the sensor sees, with the noise in its place. X is drawn within
    2 m and Y within 0.5 m of their carriers, rotations uniformly.

    Parameters
    ----------
    targets, sensors
        How many of each. No targets: odometry alone.
    seed
        Seed, or a generator to draw from. One seed gives the same frames, graph and motion at every noise level.
    graph
        ``"complete"``, ``"star"``, ``"random"`` (connected), or pairs (target index, sensor index); see
        :func:`gtsam_rwhec.simulate.graphs.bipartite_edges`.
    edge_probability
        Of the edges beyond the spanning tree of a ``"random"`` graph.
    motion
        The rig's motion, T_world_rig; a kind stands for ``Motion(kind)``.
    number_of_measurements
        For every pair, or by pair of names (target, sensor). The rig makes one trajectory, as long as the largest of
        them; a pair with fewer measurements has a random part of its poses.
    noise
        ``stated`` noise on B as it is given, that is after the scale: sigma_m is its true standard deviation at every
        scale. One for all, or by pair of names. It also gives the weights. ``None``: exact B, unit weights.
    noise_in_A
        ``stated`` noise on the right of A, one draw for each pose of the rig (pairs measured at one stamp share the
        motion capture's error). It has no part in the weights. Default: exact.
    scale
        ``"known"``, ``"shared"`` or ``"per_target"``.
    true_scale
        alpha, t_B = alpha * (true length): a number for ``"shared"`` (default 0.5), a mapping from target name to
        number for ``"per_target"`` (default: log-uniform in [1/2, 2], and 1 for the known sizes). With ``"per_target"``
        each sensor's odometry has a scale of its own too, under the sensor's name.
    known_sizes
        With ``"per_target"``, the targets (and sensors' odometries) whose scale the problem is told.
    odometry
        Number of AX = XB measurements for each sensor: A = T_rig_before_after and B = T_sensor_before_after between
        consecutive poses of a trajectory of their own.
    odometry_noise
        ``stated`` noise on the B of the odometry, and its weights. ``None``: exact, unit weights.
    keep_measurements
        Passed to :class:`gtsam_rwhec.Problem`.

    Returns
    -------
    The simulation; its truth has the frames that occur in the problem.

    Raises
    ------
    OptionError
        If there is nothing to measure, a count is negative, a mapping lacks a pair, an option does not go with the
        scale mode, or the noise is ``released``.
    ScaleError
        If a true scale is not positive and finite.
    """
    frames, edges_random, path, choice, measuring, driving = np.random.default_rng(seed).spawn(6)
    edges = bipartite_edges(graph, targets, sensors, edges_random, edge_probability)
    pairs = [Pair(f"target{j}", f"sensor{k}") for j, k in edges]
    movers = [f"sensor{k}" for k in range(sensors)] if odometry > 0 else []
    if odometry < 0:
        raise OptionError(f"general: odometry is {odometry}, but cannot be negative")
    if not pairs and not movers:
        raise OptionError(
            f"general: nothing to measure with {targets} targets, {sensors} sensors and odometry={odometry}; "
            "ask for at least one edge, or for odometry of at least one sensor"
        )
    counts = {pair: _of_pair(number_of_measurements, pair, "number_of_measurements") for pair in pairs}
    for pair, count in counts.items():
        if count < 1:
            raise OptionError(f"general: number_of_measurements of {pair} is {count}; ask for at least one, or no edge")

    X = {f"target{j}": T for j, T in enumerate(random_poses(targets, TARGETS_WITHIN_M, frames))}
    Y = {f"sensor{k}": T for k, T in enumerate(random_poses(sensors, SENSORS_WITHIN_M, frames))}
    X = {name: T for name, T in X.items() if any(name == pair.target for pair in pairs)}
    Y = {name: T for name, T in Y.items() if name in movers or any(name == pair.sensor for pair in pairs)}
    known_sizes = tuple(known_sizes)
    alphas = true_scales([*X, *movers], scale, true_scale, known_sizes, frames)
    if not isinstance(motion, Motion):
        motion = Motion(motion)
    T_rig_world = inverse(carrier_poses(motion, max(counts.values(), default=0), path))
    noisy_T_rig_world = perturb(T_rig_world, noise_in_A, measuring)

    problem = Problem(scale=scale, keep_measurements=keep_measurements)
    for pair in pairs:
        steps = np.sort(choice.permutation(len(T_rig_world))[: counts[pair]])
        B = inverse(Y[pair.sensor]) @ T_rig_world[steps] @ X[pair.target]
        B[:, :3, 3] *= alphas[pair.target] if isinstance(alphas, dict) else alphas
        noise_of_pair = None if noise is None else _of_pair(noise, pair, "noise")
        problem.add(
            *pair,
            noisy_T_rig_world[steps],
            perturb(B, noise_of_pair, measuring),
            **weights_of(noise_of_pair),
            stamps_ns=PERIOD_NS * steps,
            source="simulate.general",
        )
    for sensor in movers:
        T_start_rig = carrier_poses(motion, odometry + 1, driving)
        A = inverse(T_start_rig[:-1]) @ T_start_rig[1:]
        B = inverse(Y[sensor]) @ A @ Y[sensor]
        B[:, :3, 3] *= alphas[sensor] if isinstance(alphas, dict) else alphas
        B = perturb(B, odometry_noise, driving)
        problem.add_motion(sensor, A, B, **weights_of(odometry_noise), source="simulate.general")
    if isinstance(alphas, dict):
        for name in known_sizes:
            problem.fix_scale(name, alphas[name])
    return Simulation(problem, X=X, Y=Y, scale=alphas)


def _of_pair(value: Value | ByPair[Value], pair: Pair, option: str) -> Value:
    """The option's value for one pair of names (target, sensor)."""
    if not isinstance(value, Mapping):
        return value
    if pair not in value:
        raise OptionError(f"general: {option} has nothing for {pair}; give one for every pair, or one for all")
    return value[pair]
