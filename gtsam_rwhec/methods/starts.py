"""Where methods that descend start: where the user says, or at a closed form's answer."""

from __future__ import annotations

from gtsam_rwhec.methods.absolute import Stack, linear_rotations, linear_translations, poses_by_name
from gtsam_rwhec.methods.estimate import Poses
from gtsam_rwhec.methods.method import MethodOptions, checked_start
from gtsam_rwhec.problem.problem import Problem


def start_of(problem: Problem, options: MethodOptions) -> tuple[Poses, Poses, float, str]:
    """X, Y, scale, and what they are, in words.

    Left out, the start is Wang's answer; for several of both sides, or an unknown scale, which Wang's method has not,
    that of the same linear systems extended to them.

    Raises
    ------
    FrameError, PoseError, ScaleError
        For a start that is none.
    UnderdeterminedError
        When the linear systems do not determine one.
    """
    if options.start is not None:
        return *checked_start(problem, options.start), "the given start"
    stack = Stack.of(problem)
    R_X, R_Y = linear_rotations(stack)
    unknown = problem.scale != "known"
    t_X, t_Y, alpha = linear_translations(stack, R_X, R_Y, unknown_scale=unknown)
    words = "wang2022"
    if unknown or min(len(stack.targets), len(stack.sensors)) > 1:
        words = "wang2022's linear systems, " + ("with the scale" if unknown else "for several Xs and Ys")
    return poses_by_name(stack.targets, R_X, t_X), poses_by_name(stack.sensors, R_Y, t_Y), alpha, words
