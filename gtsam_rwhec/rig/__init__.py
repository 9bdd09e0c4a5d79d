"""Rig files: the sensors and targets, what carries them, and where the log has the data of each."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
