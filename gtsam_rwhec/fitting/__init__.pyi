# Refine poses: options, the record of a refined calibration, and its parts.
from .fit_options import ArmAccuracy as ArmAccuracy
from .fit_options import CarrierNoise as CarrierNoise
from .fit_options import RefineOptions as RefineOptions
from .refined import Movement as Movement
from .refined import PairNoise as PairNoise
from .refined import Refined as Refined
from .refined import RefinedPoses as RefinedPoses
from .refinement import refine as refine

# The noise that the data have.
from .fit_options import Component as Component
from .fit_options import NoiseOptions as NoiseOptions
from .noise_in_data import Deviation as Deviation
from .noise_in_data import NoiseInData as NoiseInData
from .noise_refinement import refine_under_noise as refine_under_noise
from .noise_refinement import under_noise as under_noise
from .noise_refinement import UnderNoise as UnderNoise

# What cameras saw, and refine from it.
from .corner_refinement import CornersCalibrated as CornersCalibrated
from .corner_refinement import calibrate_corners as calibrate_corners
from .corner_noise import Noise as Noise
from .corners_refined import CornersRefined as CornersRefined
from .corners_refined import RefinedIntrinsics as RefinedIntrinsics
from .corner_refinement import refine_corners as refine_corners
from .fit_options import CornerOptions as CornerOptions
from .observations import Observations as Observations
from .observations import Views as Views
from .observations import observations_of as observations_of
from .stated_intrinsics import Innovation as Innovation

# What it is worth: on images it has not seen, over the image, and where something stays as it is.
from .corners_as_refined import consequences_of as consequences_of
from .held_out import HeldOut as HeldOut
from .held_out import held_out_errors as held_out_errors
from .projection_uncertainty import projection_deviations as projection_deviations
