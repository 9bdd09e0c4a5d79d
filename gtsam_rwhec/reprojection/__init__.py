"""Refinement from the corners themselves: poses, intrinsics, boards and the carriers' poses in one GTSAM graph."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
