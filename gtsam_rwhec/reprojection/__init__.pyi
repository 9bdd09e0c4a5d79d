# What cameras saw.
from .observations import Observations as Observations
from .observations import Views as Views

# Refine from it.
from .options import CornerOptions as CornerOptions
from .refining import refine_corners as refine_corners

# The result, and its parts.
from .reduced import Noise as Noise
from .refined import CornersRefined as CornersRefined
from .refined import RefinedIntrinsics as RefinedIntrinsics
from .stated_intrinsics import Innovation as Innovation
