"""The noise that the data have: of B, of A, in time and over the configuration, by restricted maximum likelihood."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
