"""Shah 2013 and Wang 2022: all rotations by one linear system, then all translations by another.

Their answer is also where the methods that descend start, unless the user says otherwise.
"""

from __future__ import annotations

from gtsam_rwhec.methods.absolute import Stack, linear_outcome, linear_rotations, linear_translations, poses_by_name
from gtsam_rwhec.methods.estimate import Outcome, Poses
from gtsam_rwhec.methods.method import Method, MethodOptions, Properties, checked_start
from gtsam_rwhec.problem.problem import Problem


def linear_method(problem: Problem, options: MethodOptions) -> Outcome[Poses]:
    """Closed form. With one X and one Y, Wang's method is Shah's: singular vectors of a sum of Kronecker products."""
    stack = Stack.of(problem)
    return linear_outcome(stack, *linear_rotations(stack))


def start_of(problem: Problem, options: MethodOptions) -> tuple[Poses, Poses, float, str]:
    """X, Y, scale, and a sentence that says where they are from.

    Left out, the start is Wang's answer; for several of both sides, or an unknown scale, which Wang's method has not,
    that of the same linear systems extended to them.

    Raises
    ------
    FrameError, PoseError, ScaleError
        When the given start lacks a frame, or has something else than poses and a scale.
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


_ASSUMES = "Rotations without the translations' help, all measurements alike; at least two axes of rotation."

SHAH = Method(
    name="shah2013",
    function=linear_method,
    properties=Properties("SE(3)", joint=False),
    source="M. Shah, Solving the robot-world/hand-eye calibration problem using the Kronecker product, "
    "J. Mechanisms and Robotics 5(3), 2013",
    assumes=_ASSUMES,
)
WANG = Method(
    name="wang2022",
    function=linear_method,
    properties=Properties("SE(3)", joint=False, multiple="Xs or Ys"),
    source="Y. Wang et al., Accurate calibration of multi-perspective cameras from a generalization of the hand-eye "
    "constraint, ICRA 2022",
    assumes=_ASSUMES,
)
