"""The noise that the data have: of B, of A, in time and over the configuration, by restricted maximum likelihood."""

from gtsam_rwhec.files.optional_packages import lazy_names

__getattr__, __dir__, __all__ = lazy_names(__name__, __file__)
