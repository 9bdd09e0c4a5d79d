"""Cameras, printed targets, and poses of targets from their corners: everything of vision that needs no image."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
