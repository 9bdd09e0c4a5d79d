"""The globally optimal calibration of a problem with its certificate, and the certificate of anybody's answer."""

from gtsam_rwhec.files.optional_packages import lazy_names

__getattr__, __dir__, __all__ = lazy_names(__name__, __file__)
