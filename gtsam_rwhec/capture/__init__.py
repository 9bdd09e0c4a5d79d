"""While the robot stands there: what to measure next, the answer so far, when it is good enough, and a page for it."""

from gtsam_rwhec.files.optional_packages import lazy_names

__getattr__, __dir__, __all__ = lazy_names(__name__, __file__)
