"""The report as one HTML page: sections of blocks, each number with its place in the result's JSON."""

from gtsam_rwhec.files.optional_packages import lazy_names

__getattr__, __dir__, __all__ = lazy_names(__name__, __file__)
