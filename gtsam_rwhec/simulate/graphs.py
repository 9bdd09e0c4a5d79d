"""Which sensor sees which target: edges of a bipartite graph, as pairs (target index, sensor index)."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Literal, get_args

import numpy as np

from gtsam_rwhec.errors import OptionError
from gtsam_rwhec.simulate.noise import Seed

GraphKind = Literal["complete", "star", "random"]
Edge = tuple[int, int]


def bipartite_edges(
    graph: GraphKind | Iterable[Edge], targets: int, sensors: int, seed: Seed, edge_probability: float = 0.3
) -> list[Edge]:
    """List the edges of a graph between targets and sensors, as (target index, sensor index).

    Parameters
    ----------
    graph : "complete", "star", "random", or edges
        ``"complete"``: every sensor sees every target. ``"star"``: the fewest edges that connect all frames, all at
        sensor 0 or at target 0 (two joined stars, or one star where there is one target or one sensor). ``"random"``: a
        random spanning tree, and every other edge with probability ``edge_probability``. Given edges keep their order;
        they may leave unconnected parts, and frames without an edge.
    targets, sensors : int
        Number of targets and of sensors.
    seed : int or numpy.random.Generator
        Seed, or a generator to draw from; only ``"random"`` uses it.
    edge_probability : float
        Probability of an edge outside the tree.

    Raises
    ------
    OptionError
        For a negative count, an unknown kind, an edge given twice or out of range, or a probability outside [0, 1].
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
