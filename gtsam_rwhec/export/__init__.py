"""A calibration in the forms that others read: ROS 2 launch file, tf YAML, URDF, Kalibr's camchain."""

from gtsam_rwhec.export.camchain import camchain_yaml
from gtsam_rwhec.export.files import export_all
from gtsam_rwhec.export.static_tf import static_tf_launch
from gtsam_rwhec.export.tf_yaml import tf_yaml
from gtsam_rwhec.export.urdf import urdf_xacro
from gtsam_rwhec.rig.calibrated_frames import Frame, RigFrames

__all__ = [
    "Frame",
    "RigFrames",
    "camchain_yaml",
    "export_all",
    "static_tf_launch",
    "tf_yaml",
    "urdf_xacro",
]
