__version__: str

# State a problem.
from .problem import Measurements as Measurements
from .problem import Pair as Pair
from .problem import Prior as Prior
from .problem import Problem as Problem
from .problem import ScaleMode as ScaleMode
from .problem import read_csv as read_csv
from . import cameras as cameras
from .cameras import Camera as Camera

# Solve it, or certify somebody's answer.
from .solver import FreeDirection as FreeDirection
from .solver import Identifiability as Identifiability
from .solver import PairIdentifiability as PairIdentifiability
from .solver import Basis as Basis
from .solver import Cause as Cause
from .solver import Certificate as Certificate
from .solver import Objective as Objective
from .solver import Region as Region
from .solver import Residual as Residual
from .solver import SolveOptions as SolveOptions
from .solver import Status as Status
from .solver import Solution as Solution
from .solver import SolvedPart as SolvedPart
from .solver import certify as certify
from .solver import solve as solve

# All of it in one call: outliers, noise, a verdict, and how far off a point is.
from .calibration import CalibrateOptions as CalibrateOptions
from .calibration import Calibration as Calibration
from .calibration import Choice as Choice
from .calibration import Finding as Finding
from .calibration import Ground as Ground
from .calibration import Judgement as Judgement
from .calibration import PointUncertainty as PointUncertainty
from .calibration import Verdict as Verdict
from .calibration import calibrate as calibrate

# Refine it: covariances, outliers, time offsets; and predict measurements that it has not seen.
from .calibration import CrossValidation as CrossValidation
from .calibration import cross_validate as cross_validate
from .calibration import reading_of as reading_of
from .geometry import Trajectory as Trajectory
from .geometry import pose_covariances as pose_covariances
from .fitting import ArmAccuracy as ArmAccuracy
from .fitting import CarrierNoise as CarrierNoise
from .fitting import RefineOptions as RefineOptions
from .fitting import Refined as Refined
from .fitting import RefinedPoses as RefinedPoses
from .fitting import refine as refine

# Refine it from the corners in the images, with the cameras' intrinsics.
from . import fitting as fitting
from .fitting import CornerOptions as CornerOptions
from .fitting import CornersRefined as CornersRefined
from .fitting import Observations as Observations
from .fitting import calibrate_corners as calibrate_corners
from .fitting import refine_corners as refine_corners

# Keep it in files, print it, draw it; what changed since, and whether it still holds.
from . import report as report
from . import results as results
from .results import accept as accept
from .results import judge as judge
from .results import read_refined as read_refined
from .results import read_solution as read_solution
from .results import write_calibration as write_calibration
from .results import write_refined as write_refined
from .results import write_solution as write_solution

# From a log of images to a calibration, at once or step by step.
from . import fleet as fleet
from . import geometry as geometry
from . import logs as logs
from . import odometry as odometry
from . import runs as runs
from . import rig as rig
from . import detect as detect
from . import clouds as clouds
from .runs import calibrate_log as calibrate_log

# While the robot stands there: what to measure next, the answer so far, and when it is good enough.
from . import capture as capture
from .capture import Accuracy as Accuracy
from .capture import Plan as Plan
from .capture import PlannedPose as PlannedPose
from .capture import PlanOptions as PlanOptions
from .capture import StopDecision as StopDecision
from .capture import StoppingRule as StoppingRule
from .capture import Stream as Stream
from .capture import StreamOptions as StreamOptions
from .capture import StreamUpdate as StreamUpdate
from .capture import plan as plan

# Other methods, other libraries' calls, and problems whose truth is known.
from . import datasets as datasets
from . import methods as methods
from . import simulate as simulate

# What can go wrong.
from . import errors as errors
