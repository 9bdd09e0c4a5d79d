"""Files, for several packages: YAML with lines, atomic writes, names in natural order, text for a terminal."""

from gtsam_rwhec.files.optional_packages import lazy_names

__getattr__, __dir__, __all__ = lazy_names(__name__, __file__)
