"""What the user states: measurements by pair, scale, priors and known frames; and the moments that hold all of it."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
