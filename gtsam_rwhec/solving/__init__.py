"""The globally optimal calibration of a problem with its certificate, and the certificate of anybody's answer."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
