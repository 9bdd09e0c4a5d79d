from . import pose_covariances as pose_covariances
from . import poses as poses
from . import quaternions as quaternions
from . import rounding as rounding
