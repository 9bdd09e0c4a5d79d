"""What a report shows beside the result: residuals, images, contributions and inputs, kept in a file beside it."""

from gtsam_rwhec.files.optional_packages import lazy_names

__getattr__, __dir__, __all__ = lazy_names(__name__, __file__)
