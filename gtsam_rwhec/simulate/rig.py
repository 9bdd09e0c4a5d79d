"""Simulated rigs: any number of sensors on a moving carrier, any number of targets, noise on the measurements."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import TypeVar

import numpy as np
from rwhec_factors.se3 import inverse

from gtsam_rwhec.errors import OptionError
from gtsam_rwhec.problem.knowledge import ScaleMode
from gtsam_rwhec.problem.measurements import ByPair, Pair
from gtsam_rwhec.problem.problem import Problem
from gtsam_rwhec.simulate.graphs import Edge, GraphKind, bipartite_edges
from gtsam_rwhec.simulate.motion import Motion, MotionKind, carrier_poses
from gtsam_rwhec.simulate.noise import Noise, Seed, perturb, weights_of
from gtsam_rwhec.simulate.scales import true_scales
from gtsam_rwhec.simulate.simulation import Simulation
from gtsam_rwhec.simulate.transforms import random_poses

Value = TypeVar("Value")

#: A target's coordinates in the world are at most this, m, as in a room.
TARGETS_WITHIN_M = 2.0
#: A sensor's coordinates on the rig are at most this, m, so that a person can carry the rig.
SENSORS_WITHIN_M = 0.5
#: Two poses of the rig are this far apart in time, ns, which gives ten poses a second.
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
    Y = T_rig_sensor. The sensor measures B = T_sensor_target, and B has the noise. X is drawn within 2 m and Y within
    0.5 m of their carriers; rotations are uniform.

    Parameters
    ----------
    targets, sensors : int
        Number of each. With no targets there is only odometry.
    seed : int or numpy.random.Generator
        Seed, or a generator to draw from. One seed gives the same frames, graph and motion at every noise level.
    graph : "complete", "star", "random", or pairs (target index, sensor index)
        See :func:`gtsam_rwhec.simulate.graphs.bipartite_edges`.
    edge_probability : float
        Probability of the edges beyond the spanning tree of a ``"random"`` graph.
    motion : Motion or kind of motion
        The rig's motion, T_world_rig; a kind stands for ``Motion(kind)``.
    number_of_measurements : int, or mapping of (target, sensor) to int
        For every pair, or by pair of names. The rig has one trajectory, as long as the largest number. A pair with
        fewer measurements uses poses that are drawn from it.
    noise : Noise, mapping of (target, sensor) to Noise, or None
        ``stated`` noise on B, added after the scale: sigma_m is the true standard deviation at every scale. It also
        gives the weights. ``None``: exact B, unit weights.
    noise_in_A : Noise or None
        ``stated`` noise on the right of A, one draw for each pose of the rig: pairs with one stamp share the motion
        capture's error. The weights do not include it.
    scale : "known", "shared" or "per_target"
        The problem's scale mode.
    true_scale : float, or mapping of str to float, optional
        alpha, t_B = alpha * (true length): a number for ``"shared"`` (default 0.5), a mapping from target name to
        number for ``"per_target"`` (default: log-uniform in [1/2, 2], and 1 for the known sizes). With ``"per_target"``
        each sensor's odometry also has its own scale, under the sensor's name.
    known_sizes : iterable of str
        With ``"per_target"``, the targets (and sensors' odometries) whose scale the problem is told.
    odometry : int
        Number of AX = XB measurements for each sensor: A = T_rig_before_after and B = T_sensor_before_after between
        consecutive poses of a separate trajectory.
    odometry_noise : Noise or None
        ``stated`` noise on the odometry's B, and its weights. ``None``: exact, unit weights.
    keep_measurements : bool
        Passed to :class:`gtsam_rwhec.Problem`.

    Returns
    -------
    Simulation
        Its truth has the frames that occur in the problem.

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
            raise OptionError(f"general: number_of_measurements of {pair} is {count}; give at least one")

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
