from .covariance_report import print_refined as print_refined
from .cross_validation_table import print_cross_validation as print_cross_validation
from .pair_grid import PairGrid as PairGrid
from .pose_table import sensor_table as sensor_table
from .pose_table import target_table as target_table
from .sentences import certificate_sentence as certificate_sentence
from .solution_report import print_solution as print_solution
from .solution_report import report_console as report_console
