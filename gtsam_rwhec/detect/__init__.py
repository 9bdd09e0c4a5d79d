"""From images to corners of tags and boards, with poses and the reasons of rejected detections."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
