"""Which of a flat target's two poses each image has: that which is nearer to what a calibration predicts."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import TypeVar

import numpy as np
from rwhec_factors import se3

from gtsam_rwhec.geometry.poses import PoseLike, one_transform
from gtsam_rwhec.problem.problem import Problem
from gtsam_rwhec.reprojection.observations import Observations

Answer = TypeVar("Answer")
#: In at most so many rounds the calibration of the round before chooses between the two poses.
ROUNDS = 3


def solved_with_chosen_poses(
    observations: Observations,
    solve: Callable[[Problem], Answer],
    poses_of: Callable[[Answer], tuple[Mapping[str, PoseLike], Mapping[str, PoseLike]]],
) -> Answer:
    """An answer for the images' poses, chosen by the answer of the round before; the rounds end when no choice changes.

    `poses_of` has an answer's X and Y. Raises what `Observations.poses` and `solve` do.
    """
    answer, choices = solve(observations.poses()), observations.choices()
    for _ in range(ROUNDS - 1):
        X, Y = poses_of(answer)
        predicted = {
            (target, sensor): se3.inverse(one_transform(Y[sensor], sensor)) @ view.A @ one_transform(X[target], target)
            for (target, sensor), view in observations.views.items()
        }
        before, choices = choices, observations.choices(predicted)
        if all(np.array_equal(before[pair], choices[pair]) for pair in choices):
            break
        answer = solve(observations.poses(predicted))
    return answer
