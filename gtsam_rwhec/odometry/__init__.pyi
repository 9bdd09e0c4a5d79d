# What a sensor says of its own motion, and what a person knows.
from .tracks import OdometryNoise as OdometryNoise
from .tracks import OdometryTrack as OdometryTrack
from .given import Given as Given
from .given import Ground as Ground
from .given import KnownDirection as KnownDirection
from .options import OdometryOptions as OdometryOptions

# The calibration, and what it found.
from .calibrating import calibrate_odometries as calibrate_odometries
from .motions import Motions as Motions
from .motions import odometry_motions as odometry_motions
from .calibrated import OdometryCalibration as OdometryCalibration
from .found import JointCertificate as JointCertificate
from .found import Windows as Windows
from .found import Influence as Influence
from .found import OtherAnswer as OtherAnswer

# The verdict, and the result file.
from .judging import free_in_words as free_in_words
from .judging import judgement_of as judgement_of
from .odometry_file import OdometryResult as OdometryResult
from .odometry_file import read_odometry_result as read_odometry_result
from .odometry_file import result_of as result_of
from .odometry_file import write_odometry_result as write_odometry_result
