"""Refinement in GTSAM after the certified solution: full noise, priors, robust losses, time offsets, covariances."""

from gtsam_rwhec.files.optional_packages import lazy_names

__getattr__, __dir__, __all__ = lazy_names(__name__, __file__)
