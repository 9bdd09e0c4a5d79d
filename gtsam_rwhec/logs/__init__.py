"""Logs of robots and rigs: MCAP files with ROS 2 or Foxglove messages, read as checked records, and written."""

from gtsam_rwhec.logs.image_folder import write_image_folder
from gtsam_rwhec.logs.mcap_reader import Log, PoseSeries, Topic, open_log
from gtsam_rwhec.logs.mcap_writer import LogWriter
from gtsam_rwhec.logs.records import (
    DetectionRecord,
    ImageRecord,
    IntrinsicsRecord,
    PairRecord,
    PoseRecord,
    Record,
)
from gtsam_rwhec.logs.ros_bags import convert_ros_bag
from gtsam_rwhec.logs.transforms import TfBuffer

__all__ = [
    "DetectionRecord",
    "ImageRecord",
    "IntrinsicsRecord",
    "Log",
    "LogWriter",
    "PairRecord",
    "PoseRecord",
    "PoseSeries",
    "Record",
    "TfBuffer",
    "Topic",
    "convert_ros_bag",
    "open_log",
    "write_image_folder",
]
