"""Pictures of a calibration as PNG files: frames, residuals, coverage of the images, standard deviations.

matplotlib is imported by the first picture.
"""

from gtsam_rwhec.files.optional_packages import lazy_names

__getattr__, __dir__, __all__ = lazy_names(__name__, __file__)
