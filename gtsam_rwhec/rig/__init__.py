"""Rig files: which sensors and targets there are, on which carriers, and where the log has what is needed of each."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
