"""The cost of A X = Y B with all weights 1, as one quadratic form of a pair's 25 numbers."""

from __future__ import annotations

import numpy as np

from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.methods.absolute import Stack
from gtsam_rwhec.problem.moments import Moments, MomentStack, edge_forms


def plain_form(stack: Stack) -> Array:
    """Q (25, 25) of one pair: x' Q x is half the sum of |R_A t_X + t_A - t_Y - R_Y t_B|^2 + |R_A R_X - R_Y R_B|_F^2.

    x = [t_X, t_Y, 1, vec R_X, vec R_Y], translations about the stack's gauge; no use is made of R_X and R_Y being
    rotations.
    """
    ones = np.ones(len(stack.A))
    moments = Moments.of(stack.A, stack.B, ones, ones, stack.gauge, False, "-".join([*stack.targets, *stack.sensors]))
    stacked = MomentStack.of([moments], [False])
    translation, rotation = edge_forms(stacked.translation, stacked.rotation, stacked.kappa)
    form: Array = translation[0] + rotation[0]
    return form
