"""Results in files with their evidence; what changed between two of them, and whether an old one still holds."""

from gtsam_rwhec.files.optional_packages import lazy_names

__getattr__, __dir__, __all__ = lazy_names(__name__, __file__)
