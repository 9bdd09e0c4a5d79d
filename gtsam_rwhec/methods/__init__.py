"""Every published method for A X = Y B behind one call: ``run(name, problem)``, and what each is in ``METHODS``."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
