"""The certified optimum of re-weighted measurements, without what only a final answer needs."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.problem.problem import Problem
from gtsam_rwhec.refinement.exact_scales import with_exact_scales
from gtsam_rwhec.solver.found import Found
from gtsam_rwhec.solver.options import SolveOptions
from gtsam_rwhec.solver.parts import Part, parts_of
from gtsam_rwhec.solver.search import Search
from gtsam_rwhec.solver.variables import Answer, answer_of, rotations_as_variables, scales_of

#: Above this many free frames a gap is left open on the way: the semidefinite relaxation would take most of the time,
#: and only the last, full solution's certificate is claimed.
FRAMES_RELAXED = 12


@dataclass(frozen=True)
class CertifiedFit:
    """Poses (4, 4) of the frames that had a measurement, metres; alpha by target (or mover); whether all was certified.

    A scale is as it was found, negative too: outliers may do that on the way.
    """

    poses: dict[str, Array]
    alpha: dict[str, float]
    certified: bool


def certified_fit(problem: Problem, previous: CertifiedFit | None) -> CertifiedFit:
    """The global optimum; from the previous poses where they lead to it, which the certificate tells.

    Raises
    ------
    UnderdeterminedError
        When the measurements that are left are too few.
    """
    poses: dict[str, Array] = {}
    alpha: dict[str, float] = {}
    certified = True
    for part in parts_of(problem):
        answer, closed = _solve(part, previous)
        certified = certified and closed
        for name, R, t in zip(part.free, answer.R, answer.t, strict=True):
            T = np.eye(4)
            T[:3, :3], T[:3, 3] = R, t + part.frame_shift(name)
            poses[name] = T
        poses |= {name: problem.fixed[name] for name in part.fixed}
        alpha |= scales_of(part, answer)
    return CertifiedFit(poses, alpha, certified)


def _solve(part: Part, previous: CertifiedFit | None) -> tuple[Answer, bool]:
    search = Search.of(part, SolveOptions(max_dense_frames=FRAMES_RELAXED))
    found: Found | None = None
    if previous is not None and all(name in previous.poses for name in part.free):
        start = np.array([previous.poses[name][:3, :3] for name in part.free]).reshape(-1, 3, 3)
        found = search.run("local", rotations_as_variables(part, start))
    if found is None or not found.is_closed:
        again = search.run("auto", None)
        if found is None or again.cost < found.cost:
            found = again
    found = search.with_positive_scale(found)
    return with_exact_scales(part, answer_of(part, search.form, found.R)), found.is_closed
