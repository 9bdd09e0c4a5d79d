"""GTSAM after the certified solution: richer noise, priors, robust losses, time offsets, and honest covariances."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
