"""From point clouds to measurements: what stands still before a 3D camera or a LiDAR."""

from gtsam_rwhec.files.optional_packages import lazy_names

__getattr__, __dir__, __all__ = lazy_names(__name__, __file__)
