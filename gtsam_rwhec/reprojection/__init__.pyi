# What cameras saw.
from .observations import Observations as Observations
from .observations import Views as Views

# Refine from it.
from .options import CornerOptions as CornerOptions
from .calibrating_corners import CornersCalibrated as CornersCalibrated
from .calibrating_corners import calibrate_corners as calibrate_corners
from .problem_corners import observations_of as observations_of
from .refining import refine as refine
from .refining_corners import refine_corners as refine_corners

# The result, and its parts.
from .reduced import Noise as Noise
from .refined import CornersRefined as CornersRefined
from .refined import RefinedIntrinsics as RefinedIntrinsics
from .stated_intrinsics import Innovation as Innovation

# What it is worth: on images it has not seen, over the image, and where something stays as it is.
from .consequences import consequences_of as consequences_of
from .held_out import HeldOut as HeldOut
from .held_out import held_out_errors as held_out_errors
from .projection_uncertainty import projection_deviations as projection_deviations
