"""Logs of robots and rigs: MCAP files with ROS 2 or Foxglove messages, read as checked records."""

from gtsam_rwhec.logs.mcap_reader import Log, PoseSeries, Topic, open_log
from gtsam_rwhec.logs.records import DetectionRecord, ImageRecord, IntrinsicsRecord, PoseRecord, Record
from gtsam_rwhec.logs.transforms import TfBuffer

__all__ = [
    "DetectionRecord",
    "ImageRecord",
    "IntrinsicsRecord",
    "Log",
    "PoseRecord",
    "PoseSeries",
    "Record",
    "TfBuffer",
    "Topic",
    "open_log",
]
