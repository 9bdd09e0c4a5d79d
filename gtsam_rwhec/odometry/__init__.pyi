# What a sensor says of its own motion, and what a person knows.
from .prior_knowledge import Given as Given
from .prior_knowledge import Ground as Ground
from .prior_knowledge import KnownDirection as KnownDirection
from .prior_knowledge import KnownPose as KnownPose
from .track_comparison import OdometryNoise as OdometryNoise
from .track_comparison import OdometryOptions as OdometryOptions
from .track_comparison import OdometryTrack as OdometryTrack

# The calibration, and what it found.
from .odometry_calibration import calibrate_odometries as calibrate_odometries
from .odometry_record import OdometryCalibration as OdometryCalibration
from .odometry_record import JointCertificate as JointCertificate
from .odometry_record import Windows as Windows
from .odometry_record import Influence as Influence
from .odometry_record import OtherAnswer as OtherAnswer

# The verdict, and the result file.
from .odometry_record import free_in_words as free_in_words
from .odometry_result import OdometryResult as OdometryResult
from .odometry_result import read_odometry_result as read_odometry_result
from .odometry_result import result_of as result_of
from .odometry_result import write_odometry_result as write_odometry_result

# From a log, or files of poses, to a folder of files; what people read.
from .odometry_log import OdometrySolved as OdometrySolved
from .odometry_log import calibrate_odometry_log as calibrate_odometry_log
from .odometry_log import export_odometries as export_odometries
from .odometry_log import is_of_odometries as is_of_odometries
from .odometry_log import read_odometries as read_odometries
from .odometry_log import solve_odometries as solve_odometries
from .odometry_log import solve_odometries_into as solve_odometries_into
from .odometry_report import is_page_of_odometries as is_page_of_odometries
from .odometry_report import print_odometry as print_odometry
from .odometry_report import write_odometry_page as write_odometry_page
