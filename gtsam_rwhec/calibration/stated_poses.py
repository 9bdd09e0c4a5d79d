"""Poses that were stated, by a prior or fixed: do the measurements contradict them?

The answer with a wrong stated pose is a compromise, whose residuals are taken for noise. So the measurements are asked
without what was stated; what they say is compared with it under both covariances.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Callable
from dataclasses import dataclass

import gtsam
import numpy as np

from gtsam_rwhec.files.rounded_numbers import rounded
from gtsam_rwhec.fitting.refined import Refined
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.problem.knowledge import CONTRADICTION_SIGMAS, Prior
from gtsam_rwhec.problem.problem import Problem

#: Chance that a true stated pose is contradicted.
CHANCE = 1e-6
#: From this chance on it is doubted: that of 3.5 standard deviations of one number, as for sizes.
DOUBTFUL_CHANCE = 4.65e-4
#: A stated pose that is off by less is no mistake, but its standard deviation was too small: degrees, m.
SMALL_DEG, SMALL_M = 0.5, 0.005
#: Standard deviations of the prior that holds what the motion leaves free, m and rad.
LOOSE_M, LOOSE_RAD = 10.0, 1.0


@dataclass(frozen=True)
class StatedPose:
    """A stated pose that the measurements contradict; ``str()`` is one sentence.

    Attributes
    ----------
    frame : str
    rotation_deg, translation_m : float
        How far the pose that the measurements give is from it; 0 for a part that was not stated.
    sigmas : float
        The same in standard deviations of their difference.
    is_surely_off : bool
        Whether the measurements contradict it beyond chance; otherwise it fits them badly.
    """

    frame: str
    rotation_deg: float
    translation_m: float
    sigmas: float
    is_surely_off: bool = True

    @property
    def is_small(self) -> bool:
        """Whether the answer hardly depends on it."""
        return self.rotation_deg < SMALL_DEG and self.translation_m < SMALL_M

    def __str__(self) -> str:
        off = f"{rounded(self.rotation_deg)} deg and {rounded(1e3 * self.translation_m, 3)} mm"
        return (
            f"the stated pose of {self.frame} is {off} from the pose that the measurements give "
            f"({rounded(self.sigmas)} standard deviations)"
        )


def contradicted_poses(problem: Problem, answer: Callable[[Problem], Refined | None]) -> tuple[StatedPose, ...]:
    """Stated poses of a problem that its measurements contradict, or that fit them badly.

    Parameters
    ----------
    problem : Problem
    answer : callable
        The refined calibration of a problem; None where it has none.
    """
    stated = stated_poses(problem)
    found: list[StatedPose] = []
    loose: set[str] = set()
    without = _without(problem, loose)
    for _ in range(2):
        # What the motion leaves free is held loosely in the second round.
        free = set()
        refined = answer(without)
        for name, priors in stated.items():
            if refined is None or name not in refined.names or not np.isfinite(refined.covariance(name)).all():
                free.add(name)
            else:
                found += [one for prior in priors if (one := _compared(name, prior, refined)) is not None]
        if loose or not free:
            break
        loose, stated = free, {name: stated[name] for name in free}
        without = _without(problem, loose)
    return tuple(found)


def stated_poses(problem: Problem) -> dict[str, list[Prior]]:
    """What was stated of each frame that is measured; a fixed pose counts as a prior without noise."""
    names = (*problem.targets, *problem.sensors)
    found = {name: list(problem.priors.get(name, [])) for name in names}
    for name in names:
        if name in problem.fixed:
            found[name] = [Prior(problem.fixed[name], 0.0, math.inf)]
    return {name: priors for name, priors in found.items() if priors}


def _without(problem: Problem, loose: set[str]) -> Problem:
    """The problem without what was stated of frames; those of ``loose`` keep the pose with a large noise."""
    stated = stated_poses(problem)
    without = copy.copy(problem)  # the measurements are shared, what was stated is not
    without.fixed, without.priors = {}, {}
    for name in loose:
        without.add_prior(name, stated[name][0].transform, LOOSE_M, 0.5 / LOOSE_RAD**2)
    return without


def _compared(name: str, prior: Prior, refined: Refined) -> StatedPose | None:
    """The stated pose, if it is contradicted."""
    pose: gtsam.Pose3 = (refined.X | refined.Y)[name]
    difference: Array = gtsam.Pose3.Logmap(gtsam.Pose3(prior.transform).between(pose))
    variance = np.zeros(6)
    variance[:3] = 0.0 if prior.kappa is None else 0.5 / prior.kappa
    variance[3:] = 0.0 if prior.sigma is None else prior.sigma**2
    told = np.repeat([prior.kappa is not None, prior.sigma is not None], 3)
    both = (refined.covariance(name) + np.diag(variance))[np.ix_(told, told)]
    squared = float(difference[told] @ np.linalg.lstsq(both, difference[told], rcond=None)[0])
    limit = refined.squared_radius(int(told.sum()), 1.0 - CHANCE)
    if squared < refined.squared_radius(int(told.sum()), 1.0 - DOUBTFUL_CHANCE):
        return None
    turned_rad = 0.0 if prior.kappa is None else float(np.linalg.norm(difference[:3]))
    moved_m = 0.0 if prior.sigma is None else float(np.linalg.norm(pose.translation() - prior.transform[:3, 3]))
    return StatedPose(
        name, math.degrees(turned_rad), moved_m, math.sqrt(squared), squared >= max(limit, CONTRADICTION_SIGMAS**2)
    )
