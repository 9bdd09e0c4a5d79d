"""The same semidefinite relaxation in SCS: the peer that the benchmarks time against.

``max gamma  s.t.  Q' - sum lambda_ik A_ik - gamma e_h e_h' >= 0`` with the 20 independent constraints of each rotation,
as ``gtsam_rwhec.solver.relaxation`` has it, in SCS's standard form: minimise c'y subject to b - A y in the cone.
"""

from __future__ import annotations

import time
from dataclasses import dataclass

import numpy as np
import scipy.sparse
import scs

from gtsam_rwhec.solver.rotations import CONSTRAINTS
from gtsam_rwhec.solver.small_dual import local_indices


@dataclass(frozen=True)
class ScsResult:
    """The optimum gamma, what it took (its set-up apart), and how SCS says that it ended."""

    gamma: float
    seconds: float
    setup_seconds: float
    iterations: int
    status: str


def solve_by_scs(Q: np.ndarray, eps: float = 1e-8) -> ScsResult:
    """Solve the relaxation of Q' (9 n + 1 square) with SCS at its default settings but for its two tolerances."""
    size = len(Q)
    n = (size - 1) // 9
    # SCS stacks the lower triangle column after column, off-diagonal entries times sqrt 2.
    columns, rows = np.triu_indices(size)
    root = np.where(rows == columns, 1.0, np.sqrt(2.0))
    place = np.empty((size, size), dtype=np.int64)
    place[rows, columns] = place[columns, rows] = np.arange(len(rows))
    k, p, q = np.nonzero(CONSTRAINTS)
    k, p, q = k[p >= q], p[p >= q], q[p >= q]
    index = local_indices(n)
    entries = place[index[:, p], index[:, q]]
    values = np.broadcast_to(CONSTRAINTS[k, p, q] * np.where(p == q, 1.0, np.sqrt(2.0)), entries.shape)
    variables = 20 * np.arange(n)[:, None] + k
    A = scipy.sparse.csc_matrix(
        (
            np.append(values.ravel(), 1.0),
            (np.append(entries.ravel(), place[-1, -1]), np.append(variables.ravel(), 20 * n)),
        ),
        (len(rows), 20 * n + 1),
    )
    c = np.zeros(20 * n + 1)
    c[-1] = -1.0
    start = time.perf_counter()
    data = {"A": A, "b": Q[rows, columns] * root, "c": c}
    solver = scs.SCS(data, {"s": [size]}, eps_abs=eps, eps_rel=eps, verbose=False)
    ready = time.perf_counter()
    solution = solver.solve()
    seconds = time.perf_counter() - ready
    info = solution["info"]
    return ScsResult(float(solution["x"][-1]), seconds, ready - start, int(info["iter"]), str(info["status"]))
