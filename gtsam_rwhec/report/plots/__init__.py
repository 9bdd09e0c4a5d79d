"""Pictures of a calibration, one PNG each: frames, residuals, coverage of the images, standard deviations.

matplotlib is imported when something is drawn, not before.
"""

from gtsam_rwhec.report.plots.coverage import plot_coverage
from gtsam_rwhec.report.plots.deviations import plot_deviations
from gtsam_rwhec.report.plots.frames import plot_frames
from gtsam_rwhec.report.plots.plotted import PlottedCorners, PlottedMeasurement
from gtsam_rwhec.report.plots.residuals import plot_residuals

__all__ = [
    "PlottedCorners",
    "PlottedMeasurement",
    "plot_coverage",
    "plot_deviations",
    "plot_frames",
    "plot_residuals",
]
