"""What the user states (measurements by pair, scale, priors, known frames) and the moments of the measurements."""

from gtsam_rwhec.files.optional_packages import lazy_names

__getattr__, __dir__, __all__ = lazy_names(__name__, __file__)
