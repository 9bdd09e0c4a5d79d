"""Problems of more than 120 frames, where the multipliers of R'R = I do not suffice."""

from __future__ import annotations

from functools import cache

from small_problems import part_of

from gtsam_rwhec.problem.knowledge import ScaleMode
from gtsam_rwhec.problem.measurements import Pair
from gtsam_rwhec.simulate import Noise, general
from gtsam_rwhec.solver.search import Found, Search
from gtsam_rwhec.solver.solve_options import SolveOptions

#: Forty degrees about each axis, and 30 cm: of three measurements some frames have hardly any information.
LARGE_NOISE = Noise(0.3, 1.0)
#: Half a degree and a centimetre; and no more than a guess.
WELL, NO_INFORMATION = Noise(0.01, 6500.0), Noise(1.0, 1e-2)


def star(seed: int, scale: ScaleMode = "known", targets: int = 130) -> Search:
    """A sensor that sees each of many targets three times, with large noise."""
    simulation = general(targets, 1, seed=seed, number_of_measurements=3, noise=LARGE_NOISE, scale=scale)
    return Search.of(part_of(simulation.problem), SolveOptions())


def loop(seed: int, targets: int, max_dense_frames: int = 120) -> Search:
    """A sensor that sees its targets well; two more and another target hang on a loop with hardly any information.

    There are ``targets`` + 4 frames.
    """
    pairs = [(j, 0) for j in range(targets)] + [(0, 1), (targets, 1), (1, 2), (targets, 2)]
    noise = {Pair(f"target{j}", f"sensor{k}"): NO_INFORMATION if k else WELL for j, k in pairs}
    simulation = general(targets + 1, 3, seed=seed, graph=pairs, number_of_measurements=3, noise=noise)
    return Search.of(part_of(simulation.problem), SolveOptions(max_dense_frames=max_dense_frames))


@cache
def optimum_of_star(seed: int) -> tuple[Search, Found]:
    """The star's search, and what it finds from the spectral start."""
    search = star(seed)
    return search, search.run("auto", None)
