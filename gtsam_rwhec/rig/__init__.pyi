# Rig files, read and written.
# A calibrated rig, for export and for plots.
from .calibrated_frames import CalibratedFrame as CalibratedFrame
from .calibrated_frames import CameraLink as CameraLink
from .calibrated_frames import RigFrames as RigFrames
from .refined_frames import frames_of_refined as frames_of_refined
from .rig import Rig as Rig
from .rig_file import parse_rig as parse_rig
from .rig_file import read_rig as read_rig
from .json_schema import SCHEMA_FILE as SCHEMA_FILE
from .json_schema import rig_file_schema as rig_file_schema
from .json_schema import schema_text as schema_text
from .json_schema import editor_line as editor_line
from .reference import reference_text as reference_text
from .unfinished import TodoLine as TodoLine
from .unfinished import todo_lines as todo_lines

# The sections of a rig file.
from .intrinsics_section import Intrinsics as Intrinsics
from .sections import Carriers as Carriers
from .sections import Cleaning as Cleaning
from .sections import DetectionNoise as DetectionNoise
from .sections import Link as Link
from .sections import PoseNoise as PoseNoise
from .sections import PoseSource as PoseSource
from .sections import Sensor as Sensor
from .target_sections import AprilGridTarget as AprilGridTarget
from .target_sections import BundleTarget as BundleTarget
from .target_sections import CharucoTarget as CharucoTarget
from .target_sections import CheckerboardTarget as CheckerboardTarget
from .target_sections import TagGridTarget as TagGridTarget
from .target_sections import TagTarget as TagTarget
from .written_rig import rig_text as rig_text
