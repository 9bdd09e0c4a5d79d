"""Shah 2013 and Wang 2022: all rotations by one linear system, then all translations by another."""

from __future__ import annotations

from gtsam_rwhec.methods.absolute import Stack, linear_outcome, linear_rotations
from gtsam_rwhec.methods.estimate import Outcome, Poses
from gtsam_rwhec.methods.method import Method, MethodOptions, Properties
from gtsam_rwhec.problem.problem import Problem


def linear_method(problem: Problem, options: MethodOptions) -> Outcome[Poses]:
    """Closed form. With one X and one Y, Wang's method is Shah's: singular vectors of a sum of Kronecker products."""
    stack = Stack.of(problem)
    return linear_outcome(stack, *linear_rotations(stack))


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
