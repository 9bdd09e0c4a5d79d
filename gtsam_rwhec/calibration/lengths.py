"""Mistakes that change no residual: what lengths say about them, and what nothing can say."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from gtsam_rwhec.files.rounded_numbers import rounded
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.problem.pairs import Pair
from gtsam_rwhec.problem.problem import Problem
from gtsam_rwhec.solving.solution import Solution

#: No target is seen from farther away (m).
FAR_M = 100.0
#: No frame is mounted so far from its carrier (m) on both sides at once; one side may be a map with a distant origin.
LONG_ARM_M = 50.0


@dataclass(frozen=True)
class DoubtedLengths:
    """Lengths that no rig has; ``str()`` is one sentence. Residuals do not show the unit that A and B share.

    Attributes
    ----------
    distance_m : float
        The median distance of targets from their sensors.
    arm_m : float
        How far frames are from their carriers, as a median of the side where they are closer; nan if not determined.
    """

    distance_m: float
    arm_m: float

    def __str__(self) -> str:
        found = []
        if self.distance_m > FAR_M:
            found.append(f"targets are seen from {rounded(self.distance_m, 4)} m")
        if self.arm_m > LONG_ARM_M:
            found.append(f"targets and sensors are {rounded(self.arm_m, 4)} m from their carriers")
        return (
            f"{' and '.join(found)}: this looks like millimetres in A and B, which no residual shows; give metres: "
            "divide both by 1000"
        )


def doubted_lengths(problem: Problem, solution: Solution) -> DoubtedLengths | None:
    """Find lengths that no rig has: a target 800 m from a camera, a hand-eye lever arm of 300 m.

    Parameters
    ----------
    problem : Problem
        Needs its raw measurements for the distances.
    solution : Solution

    Returns
    -------
    DoubtedLengths or None
        None where all lengths are those of a rig.
    """
    distances = [
        np.linalg.norm(batch.B[:, :3, 3], axis=1) / _scale_of(solution, pair)
        for pair in problem.pairs
        if not pair.is_motion
        for batch in problem.batches(*pair)
    ]
    distance = float(np.median(np.concatenate(distances))) if distances else np.nan
    sides = [
        float(np.median([np.linalg.norm(T.translation()) for T in frames.values()]))
        for frames in (solution.X, solution.Y)
        if frames
    ]
    arm = min(sides) if solution.identifiability.is_unique else np.nan
    return DoubtedLengths(distance, arm) if distance > FAR_M or arm > LONG_ARM_M else None


def undetectable(problem: Problem, *, unit_is_told: bool = False) -> tuple[str, ...]:
    """The mistakes in reading A and B that would change no residual of this problem, one sentence each.

    ``unit_is_told``: lengths that no rig has showed the unit.
    """
    unit = "A and B" if problem.scale == "known" else "A"
    found = [
        f"{unit} in another unit than metres: every length of the answer would be in that unit",
        "A and B both from left-handed frames: the answer would be left-handed too",
    ][unit_is_told:]
    pairs = [pair for pair in problem.pairs if not pair.is_motion]
    names = [name for pair in pairs for name in pair]
    if pairs and len(set(names)) == len(names):  # no frame is in two pairs
        found.append(
            "A and B both inverted, or targets and sensors exchanged: X would be the pose of the sensor, and Y that of "
            "the target"
        )
    return tuple(f"data cannot tell: {each}" for each in found)


def _scale_of(solution: Solution, pair: Pair) -> float | Array:
    scale = solution.scale
    return scale[pair.target] if isinstance(scale, Mapping) else scale
