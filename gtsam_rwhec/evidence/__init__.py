"""What a report shows beside the result: residuals, images, contributions and inputs, kept in a file beside it."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
