from . import pose_covariances as pose_covariances
from . import poses as poses
from . import quaternions as quaternions
from . import rounding as rounding
from .trajectory import Trajectory as Trajectory
from .time_offset import TimeOffset as TimeOffset
from .time_offset import estimate_time_offset as estimate_time_offset
