"""From a log and a rig file to a calibration: detect, clean, solve; each stage reads the log of the one before it."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
