"""The real dataset in GTSAM: one factor a pair (edge summaries) against one factor a measurement.

    python benchmarks/edge_summaries.py [--repetitions 5]

Both optimise the chordal cost from the certified solution with every frame moved by 0.05 (a fixed random direction,
rad and m together). Times are of building the factors and of Levenberg-Marquardt, taken in turns after one round that
does not count. Then cost, gradient and Gauss-Newton Hessian of the two graphs at random points.
"""

from __future__ import annotations

import time
import warnings
from dataclasses import dataclass

import gtsam
import numpy as np
from bars import Row, benchmark_parser, print_rows
from dataset import utias_folder
from gtsam.symbol_shorthand import S, X, Y
from interleaved import in_words
from rwhec_factors import EdgeSummary, edge_summary_factor, robot_world_hand_eye_factor

import gtsam_rwhec as rw

SAME_OPTIMUM = 1e-8
SAME_FORM = 1e-9
FASTER = 20.0
OFF = 0.05
#: Of B: 7 mrad and 10 mm an axis, near the median residuals (8 mrad, 9.5 mm; their rms is 26 mrad, 20 mm).
KAPPA, SIGMA_M = 1e4, 0.01


@dataclass(frozen=True)
class Variables:
    """Keys of the frames, and whether the scale is a variable."""

    targets: dict[str, int]
    sensors: dict[str, int]
    scaled: bool

    @property
    def scale_key(self) -> int | None:
        """Key of the shared scale, if there is one."""
        return S(0) if self.scaled else None

    @property
    def poses(self) -> list[int]:
        """Keys of all poses."""
        return [*self.targets.values(), *self.sensors.values()]


def summaries(problem: rw.Problem, variables: Variables) -> gtsam.NonlinearFactorGraph:
    """One factor a pair; building it includes summing the measurements."""
    graph = gtsam.NonlinearFactorGraph()
    for target, sensor in problem.pairs:
        m = problem.measurements(target, sensor)
        origin = m.A[:, :3, 3].mean(axis=0)
        summary = EdgeSummary.of(m.A, m.B, m.sigma, m.kappa, sensor_origin=origin)
        keys = variables.targets[target], variables.sensors[sensor]
        graph.add(edge_summary_factor(*keys, summary, scale_key=variables.scale_key))
    return graph


def singles(problem: rw.Problem, variables: Variables) -> gtsam.NonlinearFactorGraph:
    """One chordal factor a measurement."""
    graph = gtsam.NonlinearFactorGraph()
    noise = gtsam.noiseModel.Diagonal.Sigmas(np.repeat([1.0 / np.sqrt(2.0 * KAPPA), SIGMA_M], 3))
    for target, sensor in problem.pairs:
        keys = variables.targets[target], variables.sensors[sensor]
        m = problem.measurements(target, sensor)
        for A, B in zip(m.A, m.B, strict=True):
            poses = gtsam.Pose3(A), gtsam.Pose3(B)
            graph.add(
                robot_world_hand_eye_factor(*keys, *poses, noise, scale_key=variables.scale_key, residual="chordal")
            )
    return graph


def optimised(graph: gtsam.NonlinearFactorGraph, start: gtsam.Values) -> gtsam.Values:
    """Levenberg-Marquardt's result, to the last digits."""
    parameters = gtsam.LevenbergMarquardtParams()
    parameters.setRelativeErrorTol(1e-15)
    parameters.setAbsoluteErrorTol(1e-15)
    return gtsam.LevenbergMarquardtOptimizer(graph, start, parameters).optimize()


def certified_values(solution: rw.Solution, variables: Variables) -> gtsam.Values:
    """The certified solution as GTSAM's values."""
    values = gtsam.Values()
    for keys, frames in ((variables.targets, solution.X), (variables.sensors, solution.Y)):
        for name, key in keys.items():
            values.insert(key, gtsam.Pose3(frames[name].matrix()))
    if variables.scaled:
        values.insert(S(0), np.array([float(solution.scale)]))
    return values


def moved(values: gtsam.Values, variables: Variables, size: float, seed: int) -> gtsam.Values:
    """Every variable moved by ``size`` in a random direction of its tangent, the scale by that factor."""
    generator = np.random.default_rng(seed)
    delta = gtsam.VectorValues()
    for key in variables.poses:
        direction = generator.standard_normal(6)
        delta.insert(key, size * direction / np.linalg.norm(direction))
    if variables.scaled:
        delta.insert(S(0), np.array([size]))
    return values.retract(delta)


def differences(one: gtsam.NonlinearFactorGraph, other: gtsam.NonlinearFactorGraph, at: gtsam.Values) -> np.ndarray:
    """Relative differences of cost, gradient and Gauss-Newton Hessian (largest entry over largest entry)."""
    ordering = gtsam.Ordering()
    for key in at.keys():  # noqa: SIM118  (Values is no mapping)
        ordering.push_back(key)
    (H, g), (H_other, g_other) = (graph.linearize(at).hessian(ordering) for graph in (one, other))
    cost, cost_other = one.error(at), other.error(at)
    return np.array(
        [
            abs(cost - cost_other) / cost_other,
            np.abs(g - g_other).max() / np.abs(g_other).max(),
            np.abs(H - H_other).max() / np.abs(H_other).max(),
        ]
    )


def rows_of(scale: rw.ScaleMode, repetitions: int) -> list[Row]:
    """Both rows for a known or shared scale."""
    problem = rw.read_csv(utias_folder(), scale=scale, sigma=SIGMA_M, kappa=KAPPA)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", rw.errors.RwhecWarning)
        solution = rw.solve(problem)
    targets = {name: X(i) for i, name in enumerate(sorted({target for target, _ in problem.pairs}))}
    sensors = {name: Y(i) for i, name in enumerate(sorted({sensor for _, sensor in problem.pairs}))}
    variables = Variables(targets, sensors, scaled=scale != "known")
    optimum = certified_values(solution, variables)
    start = moved(optimum, variables, OFF, seed=0)
    seconds: dict[str, list[float]] = {}
    graphs, ends = {}, {}
    for repetition in range(repetitions + 1):
        for name, build in (("summaries", summaries), ("singles", singles)):
            begin = time.perf_counter()
            graphs[name] = build(problem, variables)
            built = time.perf_counter()
            ends[name] = optimised(graphs[name], start)
            if repetition:
                seconds.setdefault(f"{name} build", []).append(built - begin)
                seconds.setdefault(f"{name} optimise", []).append(time.perf_counter() - built)
    median = {name: float(np.median(times)) for name, times in seconds.items()}
    total = {name: np.add(seconds[f"{name} build"], seconds[f"{name} optimise"]) for name in graphs}
    faster = float(np.median(total["singles"] / total["summaries"]))
    end = ends["summaries"]
    cost = solution.certificate.cost
    off_cost = abs(graphs["summaries"].error(end) - cost) / cost
    off_pose = max(np.abs(optimum.atPose3(k).matrix() - end.atPose3(k).matrix()).max() for k in variables.poses)
    off_scale = abs(optimum.atVector(S(0))[0] - end.atVector(S(0))[0]) if variables.scaled else 0.0
    points = [moved(optimum, variables, size, seed) for seed, size in enumerate((0.05, 0.5, 3.0))]
    worst = np.max([differences(graphs["summaries"], graphs["singles"], at) for at in points], axis=0)
    name = f"real dataset, {scale} scale"
    return [
        Row(
            f"{name}: GTSAM on edge summaries from {OFF} off, against the certified optimum: cost (relative), poses",
            f"{off_cost:.1e}, {max(off_pose, off_scale):.1e}",
            f"{SAME_OPTIMUM:g}",
            bool(max(off_cost, off_pose, off_scale) <= SAME_OPTIMUM),
        ),
        Row(
            f"    {graphs['summaries'].size()} factors in place of {graphs['singles'].size()}: times faster in all",
            f"{faster:.1f}x",
            f">= {FASTER:.0f}x",
            faster >= FASTER,
        ),
        Row(
            "    build + optimise, summaries; singles",
            "; ".join(
                f"{in_words(median[f'{kind} build'])} + {in_words(median[f'{kind} optimise'])}" for kind in graphs
            ),
        ),
        Row(
            "    cost, gradient, Gauss-Newton Hessian of the two, relative, at random points",
            ", ".join(f"{value:.1e}" for value in worst),
            f"{SAME_FORM:g}",
            bool(worst.max() <= SAME_FORM),
        ),
    ]


def rows(repetitions: int) -> list[Row]:
    """With known and with shared scale."""
    return rows_of("known", repetitions) + rows_of("shared", repetitions)


def main() -> int:
    """Print the table."""
    parser = benchmark_parser(__doc__)
    parser.add_argument("--repetitions", type=int, default=5, help="of the timings")
    arguments = parser.parse_args()
    return print_rows("Edge summaries in GTSAM", rows(arguments.repetitions), store=arguments.store)


if __name__ == "__main__":
    raise SystemExit(main())
