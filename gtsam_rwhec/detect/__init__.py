"""From images to corners of tags and boards, with poses and the reasons of rejected detections."""

from gtsam_rwhec.files.optional_packages import lazy_names

__getattr__, __dir__, __all__ = lazy_names(__name__, __file__)
