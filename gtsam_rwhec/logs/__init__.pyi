# Read a log.
# Write a log, or make one of something else.
from .hand_eye_samples import HandEyeSamples as HandEyeSamples
from .hand_eye_samples import is_samples_file as is_samples_file
from .hand_eye_samples import read_hand_eye_samples as read_hand_eye_samples
from .image_folder import is_image_folder as is_image_folder
from .image_folder import write_image_folder as write_image_folder
from .mcap_reader import Log as Log
from .mcap_reader import open_log as open_log
from .mcap_writer import LogWriter as LogWriter
from .records import Topic as Topic

# What its messages are read as.
from .records import CloudRecord as CloudRecord
from .records import DetectionRecord as DetectionRecord
from .records import ImageRecord as ImageRecord
from .records import IntrinsicsRecord as IntrinsicsRecord
from .records import PairRecord as PairRecord
from .records import PoseRecord as PoseRecord
from .records import PoseSeries as PoseSeries
from .records import Record as Record
from .ros_bags import convert_ros_bag as convert_ros_bag
from .tf_buffer import TfBuffer as TfBuffer
