# Targets and cameras.
# The steps of detection: corners to a fraction of a pixel, poses, the choice between a plane's two poses.
from .ambiguity import Choice as Choice
from .ambiguity import choose_over_time as choose_over_time
from .camera import Camera as Camera

# Detection, in one image or in all images of a log.
from .detection import Detection as Detection
from .detection import Detector as Detector
from .detection import ImageDetections as ImageDetections
from .edges import RefinedCorners as RefinedCorners
from .edges import refine_corners as refine_corners
from .images import decode_gray as decode_gray
from .intrinsics_files import read_calibration_yaml as read_calibration_yaml
from .intrinsics_files import read_kalibr_camchain as read_kalibr_camchain
from .many_images import DetectedImage as DetectedImage
from .many_images import detect_in_images as detect_in_images
from .options import DetectionOptions as DetectionOptions
from .pose import PlanePoses as PlanePoses
from .pose import plane_poses as plane_poses
from .rejection import Rejection as Rejection
from .tag_survey import SeenTag as SeenTag
from .tag_survey import tags_in_image as tags_in_image
from .targets import AprilGrid as AprilGrid
from .targets import Charuco as Charuco
from .targets import Checkerboard as Checkerboard
from .targets import Tag as Tag
from .targets import Target as Target
