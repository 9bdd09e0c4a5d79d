"""Rig files: the sensors and targets, what carries them, and where the log has the data of each."""

from gtsam_rwhec.files.optional_packages import lazy_names

__getattr__, __dir__, __all__ = lazy_names(__name__, __file__)
