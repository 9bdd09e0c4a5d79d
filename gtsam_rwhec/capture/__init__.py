"""While the robot stands there: sources of messages, and sessions that take, show and calibrate what they need."""

from gtsam_rwhec.files.optional_packages import lazy_names

__getattr__, __dir__, __all__ = lazy_names(__name__, __file__)
