"""The graph of corners against one of GTSAM's own factors: time and memory of the same optimum and covariance.

    python benchmarks/corner_native.py [--views 250]

Four cameras with 250 images each of a board of 70 corners; poses, intrinsics and the carriers' noisy poses are free,
the board is as stated, the noise is known. Each graph is built, optimised by Levenberg-Marquardt from the same start to
the same tolerance, and gives the joint covariance of poses and intrinsics, each in a process of its own, one after the
other. Times are the processor's own. Memory is the peak of the whole process, simulation and libraries included.
"""

from __future__ import annotations

import resource
import time
from dataclasses import dataclass, replace

import bars
import corner_times
import gtsam
import native_graph
import numpy as np
import simulated_cells
from rwhec_factors import se3

from gtsam_rwhec.fitting.corner_graph import CornerGraph
from gtsam_rwhec.fitting.corner_noise import Reduced
from gtsam_rwhec.geometry.blas_threads import one_blas_thread


@dataclass(frozen=True)
class Measured:
    """Processor seconds, bytes, Levenberg-Marquardt steps, poses (6 k,) from the true ones and deviations (d,)."""

    build_s: float
    optimise_s: float
    covariance_s: float
    memory: int
    iterations: int
    off: np.ndarray
    deviations: np.ndarray

    @property
    def total_s(self) -> float:
        """All together."""
        return self.build_s + self.optimise_s + self.covariance_s


@one_blas_thread()
def measured(kind: str, views: int) -> Measured:
    """Measure a graph, "ours" or "native"."""
    given = corner_times.large_cell(views)
    model, start = simulated_cells.model_and_point(given)
    model, start = replace(model, shape_priors={}), replace(start, shapes={"board": np.zeros(3)})
    times = [time.process_time()]
    graph = CornerGraph(model, start) if kind == "ours" else native_graph.NativeGraph(model, start)
    times.append(time.process_time())
    parameters = gtsam.LevenbergMarquardtParams()
    parameters.setRelativeErrorTol(1e-9)
    parameters.setAbsoluteErrorTol(1e-7)
    optimiser = gtsam.LevenbergMarquardtOptimizer(graph.graph, graph.values(start), parameters)
    values = optimiser.optimize()
    times.append(time.process_time())
    if isinstance(graph, CornerGraph):
        joint, _ = graph.covariance(values, Reduced.of(model, graph.point(values)).slots)
    else:
        joint = graph.covariance(values)
    times.append(time.process_time())
    point, truth = graph.point(values), given.X | given.Y
    off = [se3.logmap((se3.inverse(truth[name]) @ T)[None])[0] for name, T in (point.X | point.Y).items()]
    build, optimise, covariance = np.diff(times).tolist()
    memory = 1024 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return Measured(
        build, optimise, covariance, memory, optimiser.iterations(), np.concatenate(off), np.sqrt(np.diagonal(joint))
    )


def rows(views: int) -> list[bars.Row]:
    """Both graphs."""
    ours, native = (bars.alone(measured, kind, views) for kind in ("ours", "native"))
    table = []
    for name, each in (("one factor an image", ours), ("GTSAM's own, one a corner", native)):
        parts = f"{each.build_s:.1f} + {each.optimise_s:.1f} + {each.covariance_s:.1f} s"
        table.append(bars.Row(name, f"{each.total_s:.1f} s"))
        table.append(bars.Row("  to build, optimise, and have the covariance", parts))
        table.append(bars.Row("  steps", f"{each.iterations}"))
        table.append(bars.Row("  memory of the process", f"{each.memory / 1e9:.2f} GB"))
    off = np.abs(ours.off - native.off).max()
    apart = np.abs(ours.deviations / native.deviations - 1.0).max()
    return [
        *table,
        bars.Row("poses apart (rad, m)", f"{off:.0e}", "<= 1e-6", bool(off <= 1e-6)),
        bars.Row("deviations apart, a share", f"{apart:.0e}", "<= 1e-6", bool(apart <= 1e-6)),
        bars.Row("time of GTSAM's own over ours", f"{native.total_s / ours.total_s:.1f}"),
        bars.Row("memory of GTSAM's own over ours", f"{native.memory / ours.memory:.1f}"),
    ]


if __name__ == "__main__":
    bars.run_script("GTSAM's own factors of corners", rows, views=250)
