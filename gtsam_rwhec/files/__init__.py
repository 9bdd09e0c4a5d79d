"""Files, for several packages: YAML with lines, atomic writes, names in natural order, text for a terminal."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
