"""Every published method for A X = Y B behind one call: ``run(name, problem)``, and what each is in ``METHODS``."""

from gtsam_rwhec.files.optional_packages import lazy_names

__getattr__, __dir__, __all__ = lazy_names(__name__, __file__)
