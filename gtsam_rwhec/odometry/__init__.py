"""Sensors that know only their own motion: windows, the joint solution, and what planar vehicles leave free."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
