"""Refinement from the corners themselves: poses, intrinsics, boards and the carriers' poses in one GTSAM graph."""

from gtsam_rwhec.files.optional_packages import lazy_names

__getattr__, __dir__, __all__ = lazy_names(__name__, __file__)
