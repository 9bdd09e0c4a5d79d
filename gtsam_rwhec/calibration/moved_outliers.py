"""Outliers that agree with one another: what was left out says where a frame was when it was measured.

Where fewer than half of the measurements were taken after a target or a sensor has moved, they are left out as
outliers, and the others fit well. In the axes of the frame that moved, the residuals of those that were left out are
then one step: X = T X' makes B^-1 B^ = X^-1 X' for every A, while in the axes of any other frame they vary with A.
Outliers of other causes (a wrong detection, a wrong pose of an arm) agree in no frame.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from gtsam_rwhec.calibration.two_poses import TwoPoses, residual_twists
from gtsam_rwhec.fitting.refined import Refined
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.problem.pairs import Pair

#: At least so many outliers, and this share of those of a frame, agree with one another.
FEWEST, MOST_OF_THEM = 4, 0.75
#: They lie this many times their own spread from the answer, in rotation or in translation.
APART = 8.0
#: Those within so many times the spread of the measurements that were kept agree.
NEAR = 6.0
#: The step of the frame that moved is told better than that of any other frame of its pairs by this factor (the product
#: of the spreads in rotation and in translation): else it is open which of both moved.
BETTER = 3.0
#: Smallest spreads: 0.003 degrees and 10 micrometres.
LEAST = np.array([5e-5, 1e-5])
#: What moved stays moved: of those that were left out (or kept, if they are fewer) this share may be on the wrong side
#: of the moment. Outliers of one step that come and go are of another cause: another board was taken for this one.
MISPLACED = 0.2


@dataclass(frozen=True)
class Measured:
    """All measurements of a pair in their order: A and B (N, 4, 4), and which are kept (N,)."""

    A: Array
    B: Array
    kept: np.ndarray


@dataclass(frozen=True)
class _Step:
    """How the outliers of a frame lie from the answer: their median (6,), and how they spread about it."""

    frame: str
    is_sensor: bool
    middle: Array
    spread: Array
    kept: int
    agreeing: int

    @property
    def volume(self) -> float:
        """The product of the spreads in rotation and in translation."""
        return float(self.spread.prod())

    @property
    def size(self) -> Array:
        """The angle (rad) and the distance (m)."""
        return np.array([np.linalg.norm(self.middle[:3]), np.linalg.norm(self.middle[3:])])


def moved_with_outliers(refined: Refined, measured: Mapping[Pair, Measured]) -> TwoPoses | None:
    """The frame that was elsewhere when the measurements that were left out were taken; None where none was.

    Parameters
    ----------
    refined : Refined
        The answer from those that were kept.
    measured : dict of Pair to Measured
        Without those that were removed for other reasons.
    """
    frames = dict.fromkeys(name for pair in measured for name in pair.frames)
    steps = [step for name in frames if (step := _step(refined, measured, name)) is not None]
    if not steps:
        return None
    best = min(steps, key=lambda step: step.volume)
    rivals = [step for step in steps if step is not best and step.volume < BETTER * best.volume]
    if rivals:
        return None
    of_frame = [one for pair, one in measured.items() if best.frame in pair.frames]
    fewer = sum(min(int(one.kept.sum()), int((~one.kept).sum())) for one in of_frame)
    if sum(_moment(one.kept)[1] for one in of_frame) > MISPLACED * fewer:
        return None
    return TwoPoses(
        frame=best.frame,
        first=best.kept,
        second=best.agreeing,
        angle_rad=float(best.size[0]),
        distance_m=float(best.size[1]),
        from_row=_moment(of_frame[0].kept)[0] if len(of_frame) == 1 else None,
        is_sensor=best.is_sensor,
    )


def _step(refined: Refined, measured: Mapping[Pair, Measured], name: str) -> _Step | None:
    """The step that the outliers of a frame agree on; None where they do not, or where they are few."""
    kept, left_out = [], []
    for pair, one in measured.items():
        if name in pair.frames:
            twists = residual_twists(refined, pair, one.A, one.B)[pair.frames.index(name)]
            if len(twists):
                kept.append(twists[one.kept])
                left_out.append(twists[~one.kept])
    away = np.concatenate(left_out) if left_out else np.zeros((0, 6))
    if len(away) < FEWEST:
        return None
    of_kept = np.maximum(np.median(_sizes(np.concatenate(kept)), axis=0), LEAST)
    middle = np.median(away, axis=0)
    for _ in range(3):  # the median of those that agree
        off = _sizes(away - middle)
        agree = (off <= np.maximum(NEAR * of_kept, 2.0 * np.median(off, axis=0))).all(axis=1)
        if agree.sum() < FEWEST:
            return None
        middle = np.median(away[agree], axis=0)
    spread = np.maximum(np.median(_sizes(away[agree] - middle), axis=0), LEAST)
    step = _Step(name, name in refined.Y, middle, spread, sum(map(len, kept)), int(agree.sum()))
    if agree.sum() < MOST_OF_THEM * len(away) or (step.size < APART * spread).all():
        return None
    return step


def _sizes(twists: Array) -> Array:
    """Angles and distances (N, 2) of twists (N, 6)."""
    return np.asarray(np.linalg.norm(twists.reshape(-1, 2, 3), axis=2))


def _moment(kept: np.ndarray) -> tuple[int | None, int]:
    """The row, counted from one, from which most are left out (or kept) that were kept (left out) before.

    And how many are on its wrong side. Where all are kept, or all left out, there is no such row.
    """
    number = len(kept)
    if kept.all() or not kept.any():
        return None, 0
    rows = np.arange(1, number)
    before = np.cumsum(kept)[:-1]  # kept among the first `row` rows
    wrong = np.minimum((rows - before) + (kept.sum() - before), before + (number - rows) - (kept.sum() - before))
    best = int(np.argmin(wrong))
    return int(rows[best]) + 1, int(wrong[best])
