"""What people look at: tables, the grid of Figure 8, and sentences."""

from gtsam_rwhec.report.covariance_report import print_refined
from gtsam_rwhec.report.cross_validation_table import print_cross_validation
from gtsam_rwhec.report.pair_grid import PairGrid
from gtsam_rwhec.report.pose_table import sensor_table, target_table
from gtsam_rwhec.report.sentences import certificate_sentence
from gtsam_rwhec.report.solution_report import print_solution, report_console

__all__ = [
    "PairGrid",
    "certificate_sentence",
    "print_cross_validation",
    "print_refined",
    "print_solution",
    "report_console",
    "sensor_table",
    "target_table",
]
