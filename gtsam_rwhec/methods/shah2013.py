"""Shah 2013: rotations by the singular vectors of a sum of Kronecker products, then translations by least squares."""

from __future__ import annotations

from gtsam_rwhec.methods.absolute import Stack, linear_rotations, linear_translations, poses_by_name
from gtsam_rwhec.methods.protocol import Calibration, Method, MethodOptions, Properties
from gtsam_rwhec.problem.problem import Problem


def shah2013(problem: Problem, options: MethodOptions) -> Calibration:
    """One X, one Y. Closed form."""
    stack = Stack.of(problem)
    R_X, R_Y = linear_rotations(stack)
    t_X, t_Y, _ = linear_translations(stack, R_X, R_Y)
    return Calibration(poses_by_name(stack.targets, R_X, t_X), poses_by_name(stack.sensors, R_Y, t_Y))


METHOD = Method(
    name="shah2013",
    properties=Properties(
        joint=False, probabilistic=False, certifiable=False, multiple="", monocular=False, representation="SE(3)"
    ),
    source="M. Shah, Solving the robot-world/hand-eye calibration problem using the Kronecker product, "
    "J. Mechanisms and Robotics 5(3), 2013",
    assumes="Rotations without the translations' help, all measurements alike; at least two axes of rotation.",
    function=shah2013,
)
