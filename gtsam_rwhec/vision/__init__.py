"""Images of a log to poses of tags and boards, each with its covariance and what was rejected, with OpenCV."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
