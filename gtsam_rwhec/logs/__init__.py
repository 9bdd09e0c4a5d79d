"""Logs of robots and rigs: MCAP files with ROS 2 or Foxglove messages, read as checked records, and written."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
