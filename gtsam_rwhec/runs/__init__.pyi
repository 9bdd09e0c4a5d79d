# All stages in a row.
from .whole_runs import OUTPUTS as OUTPUTS
from .whole_runs import calibrate_log as calibrate_log
from .verified_log import OldCalibration as OldCalibration
from .verified_log import accept_log as accept_log
from .verified_log import verify_log as verify_log

# What cleaning does to tracks.
from .pair_consensus import Consensus as Consensus
from .pair_consensus import ConsensusOptions as ConsensusOptions
from .pair_consensus import find_consensus as find_consensus
from .cleaning_stage import synchronise as synchronise
from .cleaning_stage import thin as thin
from .cleaning_stage import without_fast as without_fast

# Stage by stage.
from .whole_runs import export_solved as export_solved
from .whole_runs import solve_into as solve_into
from .cleaning_stage import clean_log as clean_log
from .detection_stage import detect_source as detect_source
from .detection_stage import sheet_beside as sheet_beside
from .detection_stage import detect_log as detect_log
from .recorded_logs import is_folder_of_images as is_folder_of_images
from .recorded_logs import write_folder_log as write_folder_log

from .recorded_logs import is_file_of_samples as is_file_of_samples
from .recorded_logs import samples_of_rig as samples_of_rig
from .recorded_logs import samples_problem as samples_problem
from .recorded_logs import write_samples_log as write_samples_log

# Sensors that know only their own motion.
from .odometry_motions import read_odometry as read_odometry

# What comes out, and what a log that a stage wrote holds.
from .output_folder import earlier_run as earlier_run
from .run_log import CALIBRATION_LOG as CALIBRATION_LOG
from .run_log import REPORT_FILE as REPORT_FILE
from .run_log import RESULT_FILE as RESULT_FILE
from .log_corners import read_corners as read_corners
from .run_log import LogMetadata as LogMetadata
from .run_log import read_cameras as read_cameras
from .run_log import read_metadata as read_metadata
from .measured_pairs import MeasuredPairs as MeasuredPairs
from .measured_pairs import read_pairs as read_pairs
from .whole_runs import read_solved as read_solved
from .solving_stage import Calibrated as Calibrated
from .solving_stage import Solved as Solved
from .solving_stage import solve_log as solve_log
