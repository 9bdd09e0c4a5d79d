"""Many robots, many logs: one small partial result a log, merged and solved robot by robot, on one machine or many."""

from gtsam_rwhec.files.optional_packages import lazy_names

__getattr__, __dir__, __all__ = lazy_names(__name__, __file__)
