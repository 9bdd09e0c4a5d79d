"""Pictures of a calibration, one PNG each: frames, residuals, coverage of the images, standard deviations.

matplotlib is imported when something is drawn, not before.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
