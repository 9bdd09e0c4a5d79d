"""Every published method for A X = Y B and A X = X B, and OpenCV's calls: one record of methods, one of answers."""

from gtsam_rwhec.files.optional_packages import lazy_names

__getattr__, __dir__, __all__ = lazy_names(__name__, __file__)
