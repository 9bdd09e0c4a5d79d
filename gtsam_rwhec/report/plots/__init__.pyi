from .coverage import plot_coverage as plot_coverage
from .deviations import plot_deviations as plot_deviations
from .frames import plot_frames as plot_frames
from .intrinsics import plot_intrinsics as plot_intrinsics
from .plotted import PlottedCorners as PlottedCorners
from .plotted import PlottedIntrinsics as PlottedIntrinsics
from .plotted import PlottedMeasurement as PlottedMeasurement
from .residuals import plot_residuals as plot_residuals
