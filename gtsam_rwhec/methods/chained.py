"""Methods for one pair on a problem of many: each pair of the best tree is solved alone, as people do by hand.

The tree has the pairs with the most measurements (a maximum spanning tree, by Prim's algorithm), without those whose
own measurements do not determine their frames. It begins at the pair with the most measurements. A frame takes the pose
that it has in the answer of the pair by which the tree reaches it; frames that the tree has keep theirs. Where pairs
fall into unconnected parts, each part has its tree. What the other pairs measured counts nowhere: the joint answer's
gain over this is the point of the comparison.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import gtsam
import numpy as np

from gtsam_rwhec.errors import RwhecError
from gtsam_rwhec.geometry.poses import PoseLike, one_transform
from gtsam_rwhec.methods.applicability import refusal
from gtsam_rwhec.methods.estimate import Estimate, Outcome
from gtsam_rwhec.methods.method import Method, MethodOptions
from gtsam_rwhec.methods.registry import estimate_of
from gtsam_rwhec.problem.measurements import Pair
from gtsam_rwhec.problem.problem import Problem
from gtsam_rwhec.solver.solution import Solution

#: X and Y of the one pair of a problem, metres.
PairSolver = Callable[[Problem], tuple[PoseLike, PoseLike]]
Poses = dict[str, gtsam.Pose3]


@dataclass(frozen=True)
class Chained:
    """A method for one pair, on every pair of a tree.

    Attributes
    ----------
    method : str
        The method's name.
    tree : tuple of Pair
        The pairs whose answers count, in the order in which the tree took them.
    X, Y : dict of str to gtsam.Pose3
        The frames that the tree reaches.
    failed : dict of Pair to str
        Pairs that the tree avoids because the method has no answer for them, with the reason.
    unreached : tuple of str
        Frames that are in no pair that the tree can take.
    estimate : Estimate or None
        The answer under the joint objective; None where frames are unreached.
    off_mm, off_deg : float
        The largest difference of a reached frame from the joint answer; nan without a frame.
    """

    method: str
    tree: tuple[Pair, ...]
    X: Poses
    Y: Poses
    failed: dict[Pair, str]
    unreached: tuple[str, ...]
    estimate: Estimate[Poses] | None
    off_mm: float
    off_deg: float


def undetermined_pairs(problem: Problem, solution: Solution) -> tuple[Pair, ...]:
    """The pairs whose own measurements do not determine their frames: no tree takes them."""
    alone = solution.identifiability.pairs
    return tuple(pair for pair in problem.pairs if not pair.is_motion and not alone[pair].is_unique)


def solver_of(method: Method[[Problem, MethodOptions]], options: MethodOptions) -> PairSolver:
    """A method for A X = Y B as a solver of one pair; it raises what the method raises, or its refusal."""

    def solved(problem: Problem) -> tuple[PoseLike, PoseLike]:
        error = refusal(method, problem)
        if error is not None:
            raise error
        found = method.function(problem, options)
        (pair,) = problem.pairs
        return found.X[pair.target], found.Y[pair.sensor]

    return solved


def chained(name: str, solver: PairSolver, problem: Problem, solution: Solution) -> Chained:
    """Solve the pairs of the best tree by a method for one pair.

    Parameters
    ----------
    name : str
        The method's name.
    solver : callable
        Solves a problem of one pair.
    problem : Problem
        Of known scale, with raw measurements, without priors.
    solution : Solution
        The joint answer: it says which pairs are determined alone, and differences are from it.
    """
    start = time.perf_counter()
    avoided = set(undetermined_pairs(problem, solution))
    candidates = [pair for pair in problem.pairs if not pair.is_motion and pair not in avoided]
    candidates.sort(key=lambda pair: problem.moments(*pair).count, reverse=True)  # stable: the first of equals
    X: Poses = {}
    Y: Poses = {}
    tree: list[Pair] = []
    failed: dict[Pair, str] = {}
    while (pair := _next(candidates, X, Y)) is not None:
        candidates.remove(pair)
        try:
            of_pair = problem.with_measurements({pair: problem.measurements(*pair)})
            found_X, found_Y = solver(of_pair)
        except (RwhecError, np.linalg.LinAlgError) as error:
            failed[pair] = str(error)
            continue
        tree.append(pair)
        X.setdefault(pair.target, gtsam.Pose3(one_transform(found_X, pair.target)))
        Y.setdefault(pair.sensor, gtsam.Pose3(one_transform(found_Y, pair.sensor)))
    seconds = time.perf_counter() - start
    unreached = tuple(name for name in (*problem.targets, *problem.sensors) if name not in X and name not in Y)
    estimate = None if unreached else estimate_of(name, problem, Outcome(X, Y), seconds)
    differences = [solution.X[t].between(pose) for t, pose in X.items()]
    differences += [solution.Y[s].between(pose) for s, pose in Y.items()]
    off_m = [float(np.linalg.norm(T.translation())) for T in differences]
    off_rad = [float(np.linalg.norm(gtsam.Rot3.Logmap(T.rotation()))) for T in differences]
    return Chained(
        method=name,
        tree=tuple(tree),
        X=X,
        Y=Y,
        failed=failed,
        unreached=unreached,
        estimate=estimate,
        off_mm=1e3 * max(off_m, default=math.nan),
        off_deg=math.degrees(max(off_rad, default=math.nan)),
    )


def _next(candidates: list[Pair], X: Mapping[str, object], Y: Mapping[str, object]) -> Pair | None:
    """The heaviest pair from a frame of the tree to another; without one, the heaviest that begins another tree."""
    new = [pair for pair in candidates if (pair.target in X) + (pair.sensor in Y) < 2]
    touching = [pair for pair in new if pair.target in X or pair.sensor in Y]
    return next(iter(touching or new), None)
