"""The report as one HTML page: sections of blocks, each number with its place in the result's JSON."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
