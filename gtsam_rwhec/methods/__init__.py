"""Every published method for A X = Y B behind one call: ``run(name, problem)``, and what each is in ``METHODS``."""

from gtsam_rwhec.methods.comparison import Compared, Comparison, compare
from gtsam_rwhec.methods.evaluation import cost_of_answer
from gtsam_rwhec.methods.protocol import Calibration, Estimate, Method, MethodOptions, Properties
from gtsam_rwhec.methods.registry import METHODS, run

__all__ = [
    "METHODS",
    "Calibration",
    "Compared",
    "Comparison",
    "Estimate",
    "Method",
    "MethodOptions",
    "Properties",
    "compare",
    "cost_of_answer",
    "run",
]
