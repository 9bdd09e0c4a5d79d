"""A calibration in files for other programs: ROS 2 launch file, tf YAML, URDF, camera_info; Kalibr, OpenCV, COLMAP."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
