"""Measurements to try the library on: the shipped log, and public data to download."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
