"""Other answers that fit as well: the other sign of what a measured distance gives."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.odometry.found import OtherAnswer
from gtsam_rwhec.odometry.refining import refined
from gtsam_rwhec.odometry.solved_windows import Answer, Task

#: An answer that costs at most so much more than the best fits alike: two standard deviations.
ALIKE = 2.0
#: Two answers are one if no sensor is further apart than this, metres.
SAME_M = 1e-3


def other_answers(answer: Answer, task: Task, named: Callable[[Array], dict[str, Array]]) -> tuple[OtherAnswer, ...]:
    """Start from the mirror image of each distance's free shift; keep what fits alike.

    A distance is even in the shift that the drive leaves free: the sensor may be above or below.
    """
    given, free = task.given.given, answer.freedom
    if not given.distances_m or not free.by_data.shape[1]:
        return ()
    found: list[OtherAnswer] = []
    state = answer.fit.state
    determined = free.complement()
    for (first, second), _ in given.distances_m.items():
        j, k = task.given.place[first], task.given.place[second]
        for moving, fixed in ((k, j), (j, k)):
            if moving == 0:
                continue
            axis = _free_shift(answer, task, moving)
            if axis is None:
                continue
            T = state.T.copy()
            apart = T[moving, :3, 3] - T[fixed, :3, 3]
            T[moving, :3, 3] -= 2.0 * axis * float(axis @ apart)
            fit = refined(answer.windows, answer.W, replace(state, T=T), task.layout, task.given, determined)
            moved = float(np.linalg.norm(fit.state.T[:, :3, 3] - state.T[:, :3, 3], axis=1).max())
            above = fit.cost - answer.fit.cost
            if fit.converged and moved > SAME_M and above < ALIKE:
                why = (
                    f"the distance of {first} and {second} has two signs: {task.names[moving]} may be "
                    f"{moved:.3g} m away, on the other side"
                )
                found.append(OtherAnswer(why, named(fit.state.T), above))
                break
    return tuple(found)


def _free_shift(answer: Answer, task: Task, k: int) -> Array | None:
    """The unit direction (3,), in the frame of sensor 0, along which the drive leaves sensor k free to shift."""
    rows = answer.freedom.by_data[task.layout.at[k, 3:6]]
    U, s, _ = np.linalg.svd(answer.fit.state.T[k, :3, :3] @ rows)
    if not len(s) or s[0] < 0.05:
        return None
    axis: Array = U[:, 0]
    return axis
