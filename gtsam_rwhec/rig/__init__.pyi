# A calibrated rig, for export and for figures.
from .rig_frames import CalibratedFrame as CalibratedFrame
from .rig_frames import CameraLink as CameraLink
from .rig_frames import RigFrames as RigFrames
from .rig_frames import frames_of_refined as frames_of_refined

# Rig files, read and written.
from .rig import Rig as Rig
from .rig_file import parse_rig as parse_rig
from .rig_file import read_rig as read_rig
from .rig_reference import SCHEMA_FILE as SCHEMA_FILE
from .rig_reference import rig_file_schema as rig_file_schema
from .rig_reference import schema_text as schema_text
from .rig_reference import editor_line as editor_line
from .rig_reference import reference_text as reference_text
from .rig_file import TodoLine as TodoLine
from .rig_file import todo_lines as todo_lines

# A calibrated rig in files for other programs.
from .exported_cameras import camchain_yaml as camchain_yaml
from .exported_cameras import camera_info_yaml as camera_info_yaml
from .exported_cameras import colmap_cameras_txt as colmap_cameras_txt
from .exported_cameras import opencv_yaml as opencv_yaml
from .exported_files import COPIED as COPIED
from .exported_files import FILES as FILES
from .exported_files import FOLDERS as FOLDERS
from .exported_files import copied_texts as copied_texts
from .exported_files import export_all as export_all
from .exported_files import python_poses as python_poses
from .exported_files import static_tf_launch as static_tf_launch
from .exported_files import tf_yaml as tf_yaml
from .exported_files import urdf_xacro as urdf_xacro

# The sections of a rig file.
from .sections import Intrinsics as Intrinsics
from .odometry_sections import GivenDirection as GivenDirection
from .odometry_sections import GivenDistance as GivenDistance
from .odometry_sections import GivenGround as GivenGround
from .odometry_sections import GivenSection as GivenSection
from .odometry_sections import OdometryNoiseSection as OdometryNoiseSection
from .odometry_sections import OdometrySensor as OdometrySensor
from .odometry_sections import OdometrySource as OdometrySource
from .sections import Carriers as Carriers
from .sections import Cleaning as Cleaning
from .sections import DetectionNoise as DetectionNoise
from .sections import Link as Link
from .sections import PoseAccuracy as PoseAccuracy
from .sections import PoseNoise as PoseNoise
from .sections import PoseSource as PoseSource
from .sections import Sensor as Sensor
from .target_sections import AprilGridTarget as AprilGridTarget
from .target_sections import BundleTarget as BundleTarget
from .target_sections import CharucoTarget as CharucoTarget
from .target_sections import CheckerboardTarget as CheckerboardTarget
from .target_sections import TagGridTarget as TagGridTarget
from .target_sections import TagTarget as TagTarget
from .rig_file import rig_text as rig_text

# The first rig file of a log, or of a folder of images.
from .folder_contents import cloud_folders as cloud_folders
from .folder_contents import is_folder_without_logs as is_folder_without_logs
from .folder_proposal import propose_folder_rig as propose_folder_rig
from .log_proposal import propose_rig as propose_rig
from .rig_file import TEMPLATES as TEMPLATES
from .rig_file import template_text as template_text
