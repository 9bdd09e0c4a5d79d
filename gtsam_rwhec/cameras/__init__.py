"""Cameras, printed targets, and poses of targets from their corners: everything of vision that needs no image."""

from gtsam_rwhec.files.optional_packages import lazy_names

__getattr__, __dir__, __all__ = lazy_names(__name__, __file__)
