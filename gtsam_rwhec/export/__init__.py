"""A calibration in files for other programs: ROS 2 launch file, tf YAML, URDF, camera_info; Kalibr, OpenCV, COLMAP."""

from gtsam_rwhec.files.optional_packages import lazy_names

__getattr__, __dir__, __all__ = lazy_names(__name__, __file__)
