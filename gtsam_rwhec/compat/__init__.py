"""Calls with other libraries' names, argument orders and conventions, for programs that change one import."""

from gtsam_rwhec.files.optional_packages import lazy_names

__getattr__, __dir__, __all__ = lazy_names(__name__, __file__)
