"""Data to try the library on: the demo's log, which is shipped, and public data to download."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
