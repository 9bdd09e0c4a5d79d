"""The corners that a problem holds, as observations: with boards of true size, and A at the instants of the images."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from gtsam_rwhec.errors import CountError, OptionError
from gtsam_rwhec.files.natural_order import natural_key
from gtsam_rwhec.problem.pairs import Pair
from gtsam_rwhec.problem.problem import Problem
from gtsam_rwhec.refinement.pair_data import local_paths
from gtsam_rwhec.reprojection.observations import Observations, Views
from gtsam_rwhec.trajectories.trajectory import Trajectory


def observations_of(
    problem: Problem,
    *,
    scale: float | Mapping[str, float] = 1.0,
    time_offsets_s: Mapping[str, float] | None = None,
    carrier_path: Trajectory | None = None,
) -> Observations:
    """What cameras saw: the corners of a problem, in the order of its measurements.

    Parameters
    ----------
    problem : Problem
        Every measurement was added with ``add_corners``.
    scale : float or dict of str to float
        Stated over true length of the targets (`Refined.scale`): the boards have true sizes in the observations.
    time_offsets_s : dict of str to float, optional
        By sensor: A is taken that much later than the stamps, along the carriers' motion; views have its velocity.
    carrier_path : Trajectory, optional
        The carriers' motion, as in `RefineOptions`.

    Raises
    ------
    CountError
        The problem has no corners, or not of every measurement; or time offsets, and no motion of the carriers.
    MeasurementsNotKeptError
        Raw measurements were not kept.
    """
    check_corners_everywhere(problem)
    late = dict(time_offsets_s or {})
    paths = local_paths(problem, tuple(late), carrier_path)
    views: dict[tuple[str, str], Views] = {}
    for pair in problem.pairs:
        raw = problem.measurements(*pair)
        assert raw.pixels is not None
        A, twist = raw.A, None
        if pair in paths:
            A, twist = A @ paths[pair].motion(late[pair.sensor]), paths[pair].twists(late[pair.sensor])
        views[pair.target, pair.sensor] = Views(A, raw.pixels, twist)
    of = scale if isinstance(scale, Mapping) else dict.fromkeys(problem.targets, scale)
    boards = {name: board / of.get(name, 1.0) for name, board in problem.boards.items()}
    return Observations(dict(problem.cameras), boards, views, problem.corner_px or 0.1)


def check_corners_everywhere(problem: Problem) -> None:
    """A CountError where a measurement of the problem has no corners; it says of which pairs."""
    if not problem.boards:
        raise CountError(
            "the problem has no corners; add images with problem.add_corners(target, sensor, A, image_points, "
            "board_points, camera), or refine from poses (observations='poses')"
        )
    problem.require_raw_measurements("a refinement from corners")
    lacking = {}
    for pair in problem.pairs:
        pixels = problem.measurements(*pair).pixels
        count = problem.moments(*pair).count
        without = count if pixels is None else int(np.isnan(pixels).all(axis=(1, 2)).sum())
        if without:
            lacking[pair] = f"{pair} ({without} of {count})"
    if lacking:
        named = ", ".join(lacking[pair] for pair in sorted(lacking, key=_natural))
        raise CountError(
            f"measurements without corners: {named}. A refinement from corners takes no poses beside them: add these "
            "with add_corners too, leave them out, or refine from poses (observations='poses')"
        )


def check_corners_can_hold(problem: Problem) -> None:
    """An OptionError where the problem states what a refinement from corners does not hold."""
    stated = [f"the fixed pose of {name}" for name in problem.fixed]
    stated += [f"the prior of {name}" for name in problem.priors]
    if problem.scale == "shared":
        stated.append("one scale of all lengths (scale='shared'; 'per_target' estimates the boards' sizes)")
    if stated:
        raise OptionError(
            f"a refinement from corners does not hold {', '.join(stated)}; leave it out, or refine from poses "
            "(observations='poses')"
        )


def _natural(pair: Pair) -> tuple[object, ...]:
    return natural_key(pair.label)
