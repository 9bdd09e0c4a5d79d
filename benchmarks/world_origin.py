"""The origin of the carriers' world moved away: the same relative poses and cost (design fact 9).

    python benchmarks/world_origin.py

The real dataset and a simulation, at both scale modes. Two ways for the origin to be far away: the targets' carrier
(the room, for a rig that moves in it: A T(d), X moves by -d) and the sensors' carrier (an arm far from the base that
its poses are of: T(d) A, Y moves by d).
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from bars import Row, benchmark_parser, print_rows
from dataset import utias_folder
from numpy.typing import NDArray

import gtsam_rwhec as rw
from gtsam_rwhec.simulate import Noise, general

Array = NDArray[np.float64]
DIRECTION = np.array([0.6, -0.48, 0.64])
BARS = {1e3: 1e-9, 1e6: 1e-6}


def moved(problem: rw.Problem, d: Array, side: str) -> rw.Problem:
    """The same measurements with one carrier's origin moved by d (metres)."""
    result = rw.Problem(scale=problem.scale)
    for target, sensor in problem.pairs:
        m = problem.measurements(target, sensor)
        A = m.A.copy()
        A[:, :3, 3] += A[:, :3, :3] @ d if side == "targets" else d
        result.add(target, sensor, A, m.B, m.sigma, m.kappa)
    return result


def difference(near: rw.Solution, far: rw.Solution) -> tuple[float, float]:
    """Largest difference of any relative pose (its matrix' entries; m), and that of the costs, relative."""
    worst = 0.0
    for one, other in ((near.X, far.X), (near.Y, far.Y)):
        T, S = (np.array([pose.matrix() for pose in poses.values()]) for poses in (one, other))
        T, S = np.linalg.inv(T[:1]) @ T, np.linalg.inv(S[:1]) @ S
        worst = max(worst, float(np.abs(T - S).max()))
    return worst, abs(far.cost / near.cost - 1.0)


def rows() -> list[Row]:
    """Both problems, both scales, both sides, both distances."""
    simulated = Noise(sigma_m=0.005, kappa=5e3)
    problems: dict[str, Callable[[rw.ScaleMode], rw.Problem]] = {
        "real dataset": lambda scale: rw.read_csv(utias_folder(), scale=scale, sigma=1.0, kappa=1.0),
        "simulated 3 x 3": lambda scale: general(3, 3, seed=1, noise=simulated, scale=scale).problem,
    }
    result = []
    for name, make in problems.items():
        for scale in ("known", "shared"):
            problem = make(scale)
            near = rw.solve(problem)
            for side in ("targets", "sensors"):
                for distance, bar in BARS.items():
                    far = rw.solve(moved(problem, distance * DIRECTION, side))
                    poses, cost = difference(near, far)
                    result.append(
                        Row(
                            f"{name}, {scale} scale, {side}' carrier moved by {distance / 1e3:,.0f} km",
                            f"poses {poses:.1e}, cost {cost:.1e}, {far.certificate.status}",
                            f"<= {bar:g}",
                            max(poses, cost) <= bar and far.certificate.status == near.certificate.status,
                        )
                    )
    return result


def main() -> int:
    """Print the table."""
    arguments = benchmark_parser(__doc__).parse_args()
    return print_rows("World origin far away: relative poses and cost", rows(), store=arguments.store)


if __name__ == "__main__":
    raise SystemExit(main())
