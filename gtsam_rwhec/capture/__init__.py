"""While the robot stands there: which poses to measure next, the answer so far, and when it is good enough."""

from gtsam_rwhec.files.optional_packages import lazy_names

__getattr__, __dir__, __all__ = lazy_names(__name__, __file__)
