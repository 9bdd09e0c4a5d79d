"""Calls with other libraries' names, argument orders and conventions, for programs that change one import."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
