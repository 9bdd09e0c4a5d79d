"""Wang 2022: the linear rotation system of one X and one Y for several Xs or several Ys, then all translations."""

from __future__ import annotations

from gtsam_rwhec.methods.absolute import Stack, linear_rotations, linear_translations, poses_by_name
from gtsam_rwhec.methods.protocol import Calibration, Method, MethodOptions, Properties
from gtsam_rwhec.problem.problem import Problem


def wang2022(problem: Problem, options: MethodOptions) -> Calibration:
    """Several Xs or several Ys. Closed form; with one of each it is Shah's."""
    stack = Stack.of(problem)
    R_X, R_Y = linear_rotations(stack)
    t_X, t_Y, _ = linear_translations(stack, R_X, R_Y)
    return Calibration(poses_by_name(stack.targets, R_X, t_X), poses_by_name(stack.sensors, R_Y, t_Y))


METHOD = Method(
    name="wang2022",
    properties=Properties(
        joint=False,
        probabilistic=False,
        certifiable=False,
        multiple="Xs or Ys",
        monocular=False,
        representation="SE(3)",
    ),
    source="Y. Wang et al., Accurate calibration of multi-perspective cameras from a generalization of the hand-eye "
    "constraint, ICRA 2022",
    assumes="Rotations without the translations' help, all measurements alike; at least two axes of rotation.",
    function=wang2022,
)
