"""Rig files: which sensors and targets there are, on which carriers, and where the log has what is needed of each."""

from gtsam_rwhec.rig.rig import Rig
from gtsam_rwhec.rig.rig_file import parse_rig, read_rig, rig_text
from gtsam_rwhec.rig.schema import (
    AprilGridTarget,
    Carriers,
    CharucoTarget,
    CheckerboardTarget,
    Cleaning,
    Intrinsics,
    Noise,
    PoseNoise,
    PoseSource,
    Sensor,
    TagTarget,
)

__all__ = [
    "AprilGridTarget",
    "Carriers",
    "CharucoTarget",
    "CheckerboardTarget",
    "Cleaning",
    "Intrinsics",
    "Noise",
    "PoseNoise",
    "PoseSource",
    "Rig",
    "Sensor",
    "TagTarget",
    "parse_rig",
    "read_rig",
    "rig_text",
]
