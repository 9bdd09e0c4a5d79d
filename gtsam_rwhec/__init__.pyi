__version__: str

# State a problem.
from .problem.csv_folder import read_csv as read_csv
from .problem.measurements import Measurements as Measurements
from .problem.priors import Prior as Prior
from .problem.problem import Problem as Problem

# Solve it, or certify somebody's answer.
from .identifiability.identification import Identifiability as Identifiability
from .identifiability.identification import PairIdentifiability as PairIdentifiability
from .solver.certificate import Certificate as Certificate
from .solver.certificate import Status as Status
from .solver.options import SolveOptions as SolveOptions
from .solving.certified_solution import certify as certify
from .solving.certified_solution import solve as solve
from .solving.solution import Residual as Residual
from .solving.solution import Solution as Solution
from .solving.solution import SolvedPart as SolvedPart

# Refine it: covariances, outliers, time offsets; and predict measurements that it has not seen.
from .calibration.cross_validation import CrossValidation as CrossValidation
from .calibration.cross_validation import cross_validate as cross_validate
from .geometry import pose_covariances as pose_covariances
from .refinement.options import CarrierNoise as CarrierNoise
from .refinement.options import RefineOptions as RefineOptions
from .refinement.refined import Refined as Refined
from .refinement.refined import RefinedPoses as RefinedPoses
from .refinement.refining import refine as refine

# Keep it in files, print it, draw it.
from . import report as report
from .results.refined_file import read_refined as read_refined
from .results.refined_file import write_refined as write_refined
from .results.solution_file import read_solution as read_solution
from .results.solution_file import write_solution as write_solution

# From a log of images to a calibration, at once or step by step.
from . import cleaning as cleaning
from . import export as export
from . import first_rig as first_rig
from . import logs as logs
from . import pipeline as pipeline
from . import rig as rig
from . import trajectories as trajectories
from . import vision as vision
from .pipeline.all_stages import calibrate_log as calibrate_log

# Other methods, other libraries' calls, and problems whose truth is known.
from . import compat as compat
from . import datasets as datasets
from . import handeye as handeye
from . import methods as methods
from . import simulate as simulate

# What can go wrong.
from . import errors as errors
