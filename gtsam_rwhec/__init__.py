"""Certifiably optimal robot-world and hand-eye calibration around GTSAM.

State a ``Problem``, ``solve`` it: poses of every sensor and target, with a proof that no better answer exists and
what the motion leaves undetermined.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

from gtsam_rwhec import errors
from gtsam_rwhec.calibration.cross_validation import CrossValidation, cross_validate
from gtsam_rwhec.geometry import pose_covariances
from gtsam_rwhec.identifiability.identification import Identifiability, PairIdentifiability
from gtsam_rwhec.problem.csv_folder import read_csv
from gtsam_rwhec.problem.measurements import Measurements
from gtsam_rwhec.problem.priors import Prior
from gtsam_rwhec.problem.problem import Problem
from gtsam_rwhec.refinement.options import CarrierNoise, RefineOptions
from gtsam_rwhec.refinement.refined import Refined, RefinedPoses
from gtsam_rwhec.refinement.refining import refine
from gtsam_rwhec.results.refined_file import read_refined, write_refined
from gtsam_rwhec.results.solution_file import read_solution, write_solution
from gtsam_rwhec.solver.certificate import Certificate, Status
from gtsam_rwhec.solver.options import SolveOptions
from gtsam_rwhec.solving.certified_solution import certify, solve
from gtsam_rwhec.solving.solution import Residual, Solution, SolvedPart

if TYPE_CHECKING:
    from gtsam_rwhec import handeye, methods, simulate

__version__ = "0.1.0"

__all__ = [
    "CarrierNoise",
    "Certificate",
    "CrossValidation",
    "Identifiability",
    "Measurements",
    "PairIdentifiability",
    "Prior",
    "Problem",
    "RefineOptions",
    "Refined",
    "RefinedPoses",
    "Residual",
    "Solution",
    "SolveOptions",
    "SolvedPart",
    "Status",
    "certify",
    "cross_validate",
    "errors",
    "handeye",
    "methods",
    "pose_covariances",
    "read_csv",
    "read_refined",
    "read_solution",
    "refine",
    "simulate",
    "solve",
    "write_refined",
    "write_solution",
]


#: Imported when they are first asked for: the simulators and the other methods bring in more of SciPy than the rest.
_LATER = ("handeye", "methods", "simulate")


def __getattr__(name: str) -> Any:
    if name in _LATER:
        return import_module(f"gtsam_rwhec.{name}")
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
