"""Logs of robots and rigs: MCAP files with ROS 2 or Foxglove messages, read as checked records, and written."""

from gtsam_rwhec.files.optional_packages import lazy_names

__getattr__, __dir__, __all__ = lazy_names(__name__, __file__)
