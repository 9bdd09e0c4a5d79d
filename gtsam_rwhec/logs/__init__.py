"""Logs of robots and rigs: MCAP files with ROS 2 or Foxglove messages, read as checked records, and written."""

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
    "open_log",
]
