"""GTSAM after the certified solution: refinement from poses and from corners, noise, outliers, covariances."""

from gtsam_rwhec.files.optional_packages import lazy_names

__getattr__, __dir__, __all__ = lazy_names(__name__, __file__)
