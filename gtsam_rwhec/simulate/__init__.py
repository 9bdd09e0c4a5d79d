"""Simulated calibration problems whose truth is known.

:func:`sphere` and :func:`cameras` are the RWHEC paper's Sections 8.1 and 8.2. They place the noise as the paper does,
so there the camera is the ``target`` (see their module). :func:`general` makes problems of any size, graph,
motion and scale, with the noise on the sensors' measurements. Each returns a :class:`Simulation`.
"""

from gtsam_rwhec.files.optional_packages import lazy_names

__getattr__, __dir__, __all__ = lazy_names(__name__, __file__)
