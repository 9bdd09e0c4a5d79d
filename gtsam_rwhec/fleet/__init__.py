"""Many robots, many logs: one small partial result a log, merged and solved robot by robot, on one machine or many."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
