"""From a log and a rig file to a calibration: detect, clean, solve, export."""

from gtsam_rwhec.files.optional_packages import lazy_names

__getattr__, __dir__, __all__ = lazy_names(__name__, __file__)
