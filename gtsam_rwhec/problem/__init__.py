"""What the user states (measurements by pair, scale, priors, known frames) and the moments of the measurements."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
