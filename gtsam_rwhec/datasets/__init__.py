"""Data to try the library on: the demo's log, which is shipped, and public data to download."""

from gtsam_rwhec.files.optional_packages import lazy_names

__getattr__, __dir__, __all__ = lazy_names(__name__, __file__)
