"""Simulated rigs: any number of sensors on a moving carrier, any number of targets, noise on the measurements."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Literal, TypeVar, get_args

import numpy as np
from rwhec_factors.se3 import inverse, pose

from gtsam_rwhec.errors import OptionError
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.problem.knowledge import ScaleMode, checked_scale
from gtsam_rwhec.problem.measurements import ByPair, Pair
from gtsam_rwhec.problem.problem import Problem
from gtsam_rwhec.simulate.simulated_noise import (
    Noise,
    Seed,
    perturb,
    random_directions,
    random_poses,
    rotations_of_vectors,
    weights_of,
)
from gtsam_rwhec.simulate.simulation import Simulation

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
    0.5 m of their carriers; rotations are uniform. The truth has the frames that occur in the problem.

    Parameters
    ----------
    targets, sensors : int
        Number of each. With no targets there is only odometry.
    seed : int or numpy.random.Generator
        One seed gives the same frames, graph and motion at every noise level.
    graph : "complete", "star", "random", or pairs (target index, sensor index)
        See :func:`gtsam_rwhec.simulate.simulated_rigs.bipartite_edges`, also for `edge_probability`.
    motion : Motion or kind of motion
        The rig's motion, T_world_rig; a kind stands for ``Motion(kind)``.
    number_of_measurements : int, or mapping of (target, sensor) to int
        The rig has one trajectory, as long as the largest number. A pair with fewer measurements uses poses that are
        drawn from it.
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
        consecutive poses of a separate trajectory. `odometry_noise` is on that B, and gives its weights.

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


MotionKind = Literal["general", "planar", "single_axis", "none"]


@dataclass(frozen=True, slots=True)
class Motion:
    """How a carrier moves. Each pose is drawn independently.

    Raises
    ------
    OptionError
        For an unknown kind, a zero axis, or a size that is negative or not finite.
    """

    #: ``"general"``: rotations about all axes, translations in a cube. ``"planar"``: rotations about one axis,
    #: translations perpendicular to it. ``"single_axis"``: rotations about one axis, translations in a cube.
    #: ``"none"``: no rotation, translations in a cube.
    kind: MotionKind = "general"
    #: Rotation axis of planar and single-axis motion, in the frame that does not move, of any length. The default z
    #: suits a wheeled robot's floor.
    axis: tuple[float, float, float] = (0.0, 0.0, 1.0)
    #: Rotation angles are uniform in [-max_angle_rad, max_angle_rad]. The default pi is the most there is; small values
    #: give poorly excited problems.
    max_angle_rad: float = math.pi
    extent_m: float = 1.0  #: Half-width of the cube, metres. The default of one metre is a robot arm's reach.
    #: wobble_rad, wobble_m: standard deviations of an added Gaussian motion, about and along each axis, for example for
    #: "nearly planar" motion. The default 0 keeps the kind exact.
    wobble_rad: float = 0.0
    wobble_m: float = 0.0

    def __post_init__(self) -> None:
        if self.kind not in get_args(MotionKind):
            raise OptionError(f"Motion: kind is {self.kind!r}; choose one of {', '.join(get_args(MotionKind))}")
        length = math.hypot(*self.axis)
        if not (math.isfinite(length) and length > 0.0):
            raise OptionError(f"Motion: axis is {self.axis}, but must be finite and not zero")
        for name in ("max_angle_rad", "extent_m", "wobble_rad", "wobble_m"):
            size = getattr(self, name)
            if not (math.isfinite(size) and size >= 0.0):
                raise OptionError(f"Motion: {name} is {size!r}, but must be finite and not negative")


def carrier_poses(motion: Motion, count: int, seed: Seed) -> Array:
    """Draw ``count`` poses T_world_carrier (N, 4, 4), metres; ``seed`` is a seed or a generator to draw from."""
    generator = np.random.default_rng(seed)
    axis = np.array(motion.axis) / math.hypot(*motion.axis)
    if motion.kind == "general":
        axes = random_directions(count, generator)
    else:
        axes = np.tile(axis if motion.kind != "none" else np.zeros(3), (count, 1))
    angles = generator.uniform(-motion.max_angle_rad, motion.max_angle_rad, (count, 1))
    rotations = rotations_of_vectors(angles * axes)
    translations = generator.uniform(-motion.extent_m, motion.extent_m, (count, 3))
    if motion.kind == "planar":
        translations -= np.outer(translations @ axis, axis)
    if motion.wobble_rad > 0.0:
        rotations = rotations @ rotations_of_vectors(generator.normal(0.0, motion.wobble_rad, (count, 3)))
    translations = translations + generator.normal(0.0, motion.wobble_m, (count, 3))
    return pose(rotations, translations)


GraphKind = Literal["complete", "star", "random"]
Edge = tuple[int, int]


def bipartite_edges(
    graph: GraphKind | Iterable[Edge], targets: int, sensors: int, seed: Seed, edge_probability: float = 0.3
) -> list[Edge]:
    """List the edges of a graph between targets and sensors, as (target index, sensor index).

    ``"complete"``: every sensor sees every target. ``"star"``: the fewest edges that connect all frames, all at sensor
    0 or at target 0. ``"random"``: a random spanning tree, and every other edge with probability `edge_probability`.
    Given edges keep their order; they may leave unconnected parts, and frames without an edge. Raises `OptionError` for
    a negative count, an unknown kind, an edge given twice or out of range, or a probability outside [0, 1].
    """
    if targets < 0 or sensors < 0:
        raise OptionError(f"graph: {targets} targets and {sensors} sensors; counts cannot be negative")
    if not 0.0 <= edge_probability <= 1.0:
        raise OptionError(f"graph: edge_probability is {edge_probability!r}, but must lie in [0, 1]")
    if isinstance(graph, str):
        if graph not in get_args(GraphKind):
            raise OptionError(f"graph: {graph!r} is unknown; choose complete, star or random, or give the edges")
        if targets == 0 or sensors == 0:
            return []
        if graph == "complete":
            return [(j, k) for j in range(targets) for k in range(sensors)]
        if graph == "star":
            return [(0, k) for k in range(sensors)] + [(j, 0) for j in range(1, targets)]
        return _random_connected(targets, sensors, np.random.default_rng(seed), edge_probability)

    edges = [(int(j), int(k)) for j, k in graph]
    for j, k in edges:
        if not (0 <= j < targets and 0 <= k < sensors):
            raise OptionError(
                f"graph: edge ({j}, {k}) is outside {targets} targets and {sensors} sensors; give (target, sensor), "
                "each counted from 0"
            )
    if len(set(edges)) < len(edges):
        twice = next(edge for edge in edges if edges.count(edge) > 1)
        raise OptionError(f"graph: edge {twice} is given twice; ask for more measurements on it instead")
    return edges


def _random_connected(
    targets: int, sensors: int, generator: np.random.Generator, edge_probability: float
) -> list[Edge]:
    # Each frame is joined to a random frame of the other kind in the tree. The tree starts with one frame of each kind,
    # so there always is one.
    tree_targets = [int(generator.integers(targets))]
    tree_sensors = [int(generator.integers(sensors))]
    edges = {(tree_targets[0], tree_sensors[0])}
    waiting = [(True, j) for j in range(targets) if j != tree_targets[0]]
    waiting += [(False, k) for k in range(sensors) if k != tree_sensors[0]]
    for index in generator.permutation(len(waiting)):
        is_target, frame = waiting[index]
        if is_target:
            edges.add((frame, int(generator.choice(tree_sensors))))
            tree_targets.append(frame)
        else:
            edges.add((int(generator.choice(tree_targets)), frame))
            tree_sensors.append(frame)
    extra = generator.random((targets, sensors)) < edge_probability
    return sorted(edges | {(int(j), int(k)) for j, k in np.argwhere(extra)})


#: A shared scale has this alpha, unless it is given. The paper's monocular simulations have it too.
SHARED_SCALE = 0.5


def true_scales(
    names: list[str],
    mode: ScaleMode,
    given: float | Mapping[str, float] | None,
    known_sizes: tuple[str, ...],
    seed: Seed,
) -> float | dict[str, float]:
    """Check the scales that a caller gives, and draw the scales that it leaves out: alpha, or alpha by name.

    With ``"per_target"`` each target, and each sensor with odometry, has its own scale in ``names``. Scales that are
    not given are 1 (known), 0.5 (shared), or log-uniform in [1/2, 2] with 1 for ``known_sizes``, whose scale the
    problem is told. Raises OptionError for an unknown mode or name, a missing name, or a kind of scale that does not go
    with the mode, and ScaleError if a scale is not positive and finite.
    """
    if mode not in get_args(ScaleMode):
        raise OptionError(f"true_scale: scale is {mode!r}; choose one of {', '.join(get_args(ScaleMode))}")
    if mode == "per_target":
        return _scales_by_name(names, given, known_sizes, np.random.default_rng(seed))
    if known_sizes:
        raise OptionError(f'true_scale: known_sizes need scale="per_target", not {mode!r}')
    if isinstance(given, Mapping):
        raise OptionError(f"true_scale: a mapping is given, but with scale={mode!r} there is one scale; give a number")
    default = 1.0 if mode == "known" else SHARED_SCALE
    alpha = checked_scale(default if given is None else given, "true_scale")
    if mode == "known" and alpha != 1.0:
        raise OptionError(f'true_scale: {alpha!r} is given, but with scale="known" it is 1; choose scale="shared"')
    return alpha


def _scales_by_name(
    names: list[str],
    given: float | Mapping[str, float] | None,
    known_sizes: tuple[str, ...],
    generator: np.random.Generator,
) -> dict[str, float]:
    unknown = [name for name in known_sizes if name not in names]
    if unknown:
        raise OptionError(f"true_scale: known_sizes has {', '.join(unknown)}, but only {', '.join(names)} have a scale")
    if given is None:
        drawn = np.exp(generator.uniform(-math.log(2.0), math.log(2.0), len(names)))
        return {n: 1.0 if n in known_sizes else float(alpha) for n, alpha in zip(names, drawn, strict=True)}
    if not isinstance(given, Mapping):
        raise OptionError(f'true_scale: {given!r} is given; with scale="per_target" give a mapping from name to scale')
    missing = [name for name in names if name not in given]
    if missing:
        raise OptionError(f"true_scale: no scale is given for {', '.join(missing)}; give one for every target")
    return {name: checked_scale(given[name], f"true_scale of {name}") for name in names}
