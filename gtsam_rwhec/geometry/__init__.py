"""Poses as users give them, checked; quaternions; covariances of poses in other frames and conventions."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
