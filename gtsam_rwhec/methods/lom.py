"""LOM, the RWHEC paper's local on-manifold baseline (Appendix C), from a start or from a closed form's answer."""

from __future__ import annotations

from gtsam_rwhec.errors import ScaleError
from gtsam_rwhec.methods.local_on_manifold import LomOptions, check_problem, local_on_manifold
from gtsam_rwhec.methods.protocol import Calibration, Method, MethodOptions, Properties
from gtsam_rwhec.methods.starts import start_of
from gtsam_rwhec.problem.problem import Problem


def lom(problem: Problem, options: MethodOptions) -> Calibration:
    """Problem 9, with the paper's weights."""
    X, Y, scale, starts_from = start_of(problem, options)
    found = local_on_manifold(problem, X, Y, scale, LomOptions(max_iterations=options.max_iterations))
    if found.scale <= 0.0:
        raise ScaleError(
            f"LOM, started from {starts_from}, ended at scale {found.scale:.6g}: a local minimum that is no "
            "calibration; give another start"
        )
    return Calibration(found.X, found.Y, found.scale, starts_from=starts_from)


METHOD = Method(
    name="lom",
    properties=Properties(
        joint=True,
        probabilistic=True,
        certifiable=False,
        multiple="Xs and Ys",
        monocular=True,
        representation="SE(3)",
    ),
    source="E. Wise et al., A certifiably correct algorithm for generalized robot-world and hand-eye calibration, "
    "arXiv 2507.23045, Appendix C",
    assumes="A start near the answer; isotropic noise on B, exact A.",
    function=lom,
    check=check_problem,
)
