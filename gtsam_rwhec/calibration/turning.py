"""How the carriers turned: about one axis only, in a plane, or too little; said where it is why poses are not known.

Tsai and Lenz (1989), section IV: the error of a hand-eye rotation falls with the sine of the angle between the axes of
two motions, and that of its translation with the angle of the motions. So an arm that hardly turns magnifies every
error that does not average out (of the arm, of the lens, of the board), and no residual shows it.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import numpy as np
from rwhec_factors.se3 import inverse
from scipy.spatial.transform import Rotation

from gtsam_rwhec.calibration.verdict import Finding, Ground
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.identifiability.free_directions import FreeDirection, FreeReason
from gtsam_rwhec.problem.pairs import Pair
from gtsam_rwhec.problem.problem import Problem

#: Standard deviations about the axis with the second most turning: below this the carriers turned too little.
LITTLE_RAD = float(np.radians(2.0))
#: A motion is planar where what it moves along its axis is below this share of what it moves across it.
FLAT = 0.02


@dataclass(frozen=True)
class Turning:
    """How a carrier turned about its mean: standard deviations (3,) rad about its principal axes, the largest first.

    Attributes
    ----------
    spread_rad : (3,) array
    along_m, across_m : float
        Standard deviations of what it moved along the axis with most turning, and across it.
    """

    spread_rad: Array
    along_m: float
    across_m: float

    @property
    def is_little(self) -> bool:
        """Whether it hardly turned about a second axis."""
        return bool(self.spread_rad[1] < LITTLE_RAD)

    @property
    def is_planar(self) -> bool:
        """Whether it moved in a plane, if it turned about one axis only."""
        return self.along_m < FLAT * self.across_m


def turning_of(A: Array) -> Turning:
    """How a carrier turned in poses A (N, 4, 4), T_sensorcarrier_targetcarrier."""
    moved = A @ inverse(A[:1])
    rotations = Rotation.from_matrix(moved[:, :3, :3])
    turns = (rotations * rotations.mean().inv()).as_rotvec()
    values, axes = np.linalg.eigh(turns.T @ turns / len(A))
    places = moved[:, :3, 3] - moved[:, :3, 3].mean(axis=0)
    along = places @ axes[:, -1]
    across = places - along[:, None] * axes[:, -1]
    return Turning(
        np.sqrt(np.maximum(values[::-1], 0.0)),
        float(np.sqrt(np.mean(along**2))),
        float(np.sqrt(np.mean((across**2).sum(axis=1)))),
    )


def of_turning(
    problem: Problem, inliers: Mapping[Pair, np.ndarray], free: Iterable[FreeDirection], *, is_answered: bool
) -> list[Finding]:
    """What the carriers' turning says: why a direction is free, or that they turned too little.

    The sensor whose carrier turned most counts: where sensors see the same targets, it determines the others too.
    """
    if not problem.has_measurements or problem.fixed or problem.priors:
        return []
    found = [turning_of(A) for A in _of_sensors(problem, inliers).values() if len(A) > 2]
    if not found:
        return []
    most = max(found, key=lambda one: float(one.spread_rad[1]))
    reasons = {direction.reason for direction in free}
    if FreeReason.NO_ROTATION in reasons:
        return [Finding(Ground.NOT_UNIQUE, "too little rotation: the carriers hardly turn")]
    if FreeReason.ONE_AXIS in reasons:
        if most.is_planar:
            words = (
                f"planar motion: the carriers turn about one axis only, and move {1e3 * most.across_m:.0f} mm across "
                f"it but {1e3 * most.along_m:.1f} mm along it (standard deviations)"
            )
        else:
            words = "motion about one axis only: the carriers never turn about a second one"
        return [Finding(Ground.NOT_UNIQUE, words)]
    if reasons or not is_answered or not most.is_little:
        return []
    first, second = (f"{np.degrees(spread):.2g} degrees" for spread in most.spread_rad[:2])
    about = f"{first} about one axis and {second} about a second one"
    words = (
        f"too little rotation: the carriers turn by {about} (standard deviations), which magnifies every error that "
    )
    return [Finding(Ground.LITTLE_ROTATION, f"{words}does not average out, and no residual shows it")]


def _of_sensors(problem: Problem, inliers: Mapping[Pair, np.ndarray]) -> dict[str, Array]:
    """The carriers' poses (N, 4, 4) in all kept measurements of each sensor."""
    of_sensor: dict[str, list[Array]] = {}
    for pair in problem.pairs:
        if not pair.is_motion:
            A = problem.measurements(*pair).A
            of_sensor.setdefault(pair.sensor, []).append(A[inliers[pair]] if pair in inliers else A)
    return {name: np.concatenate(parts) for name, parts in of_sensor.items()}
