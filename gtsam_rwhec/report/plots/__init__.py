"""Pictures of a calibration as PNG files: frames, residuals, coverage of the images, standard deviations.

matplotlib is imported by the first picture.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
