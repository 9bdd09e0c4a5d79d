"""What is said of how A and B were read: a likely mistake, or residuals that no sensor has."""

from __future__ import annotations

from dataclasses import dataclass

from gtsam_rwhec.calibration.misreadings import Misreading, misreadings
from gtsam_rwhec.calibration.plausibility import Implausible, implausible
from gtsam_rwhec.calibration.verdict import Finding, Ground
from gtsam_rwhec.files.progress import Progress, silent
from gtsam_rwhec.problem.problem import Problem
from gtsam_rwhec.solving.solution import Solution


@dataclass(frozen=True)
class Reading:
    """The likely misreadings of a problem's poses; without any, residuals that no sensor has."""

    misreadings: tuple[Misreading, ...] = ()
    implausible: Implausible | None = None

    @property
    def finding(self) -> Finding | None:
        """The ground against the poses, in words; None where nothing is wrong."""
        found = self.misreadings
        if found:
            return Finding(Ground.MISREAD, " (or: ".join(map(str, found)) + ")" * (len(found) - 1))
        return None if self.implausible is None else Finding(Ground.IMPLAUSIBLE, str(self.implausible))


def reading_of(problem: Problem, solution: Solution | None, progress: Progress | None = None) -> Reading:
    """How a problem's poses were read, by its certified solution; None where it has none with a positive scale."""
    found = misreadings(problem, solution, progress=progress or silent)
    return Reading(found, None if found else implausible(problem, solution))
