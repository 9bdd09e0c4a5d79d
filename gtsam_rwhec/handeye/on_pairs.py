"""Methods for A X = X B on the measurements of one pair, for comparisons: X from the motions, then Y from X.

From A_i X = Y B_i of two following measurements, C X = X H with C = A_j^-1 A_i and H = B_j^-1 B_i.
"""

from __future__ import annotations

from functools import partial

import numpy as np

from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.handeye.registry import solve
from gtsam_rwhec.methods.chained import PairSolver
from gtsam_rwhec.problem.problem import Problem


def solved_pair(problem: Problem, method: str) -> tuple[Array, Array]:
    """X and Y (4, 4) of the one pair of a problem, metres; raises what ``gtsam_rwhec.handeye.solve`` raises."""
    (pair,) = problem.pairs
    raw = problem.measurements(*pair)
    C = np.linalg.inv(raw.A[1:]) @ raw.A[:-1]
    H = np.linalg.inv(raw.B[1:]) @ raw.B[:-1]
    X = solve(C, H, method).X.matrix()
    Ys = raw.A @ X @ np.linalg.inv(raw.B)
    U, _, Vt = np.linalg.svd(Ys[:, :3, :3].sum(axis=0))
    Y = np.eye(4)
    Y[:3, :3] = U @ np.diag([1.0, 1.0, np.linalg.det(U @ Vt)]) @ Vt  # the rotation nearest to their mean
    Y[:3, 3] = Ys[:, :3, 3].mean(axis=0)
    return X, Y


#: Solvers of one pair by A X = X B, by their names in comparisons.
PAIR_SOLVERS: dict[str, PairSolver] = {
    f"AX=XB {name}": partial(solved_pair, method=name) for name in ("dan", "dqopt", "dqnlopt")
}
