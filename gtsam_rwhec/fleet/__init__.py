"""Calibrate many robots: each log gives a small partial result; then each robot is solved. One machine or many."""

from gtsam_rwhec.files.optional_packages import lazy_names

__getattr__, __dir__, __all__ = lazy_names(__name__, __file__)
