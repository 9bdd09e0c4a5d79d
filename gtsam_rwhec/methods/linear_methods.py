"""Shah 2013 and Wang 2022: a linear system for all rotations, then a linear system for all translations.

Methods that descend start from this answer, unless the user gives a start.
"""

from __future__ import annotations

from gtsam_rwhec.methods.absolute import Stack, linear_outcome, linear_rotations, linear_translations
from gtsam_rwhec.methods.estimate import Outcome, Poses
from gtsam_rwhec.methods.method import Method, MethodOptions, Properties, checked_start
from gtsam_rwhec.problem.problem import Problem


def linear_method(problem: Problem, options: MethodOptions) -> Outcome[Poses]:
    """Closed form. With one X and one Y, Wang's method is Shah's: singular vectors of a sum of Kronecker products."""
    stack = Stack.of(problem)
    return linear_outcome(stack, linear_rotations(stack))


def start_of(problem: Problem, options: MethodOptions) -> tuple[Poses, Poses, float, str]:
    """X, Y, scale, and a text that names their source: the given start, else Wang's answer.

    Wang's linear systems are extended to several Xs and Ys and to an unknown scale, which his method does not have.
    Raises FrameError, PoseError or ScaleError for a given start that lacks a frame or has other values than poses and a
    scale, and UnderdeterminedError when the linear systems do not determine a start.
    """
    if options.start is not None:
        return *checked_start(problem.targets, problem.sensors, options.start), "the given start"
    stack = Stack.of(problem)
    unknown = problem.scale != "known"
    R = linear_rotations(stack)
    t, alpha = linear_translations(stack, R, unknown_scale=unknown)
    start = stack.outcome(R, t)
    words = "wang2022"
    if unknown or min(len(stack.targets), len(stack.sensors)) > 1:
        words = "wang2022's linear systems, " + ("with the scale" if unknown else "for several Xs and Ys")
    return start.X, start.Y, alpha, words


_ASSUMES = "All measurements equally accurate, at least two axes of rotation. Translations do not help the rotations."

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
