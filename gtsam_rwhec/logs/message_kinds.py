"""A log's topics, and names of topics and schemas by content: transforms, images, intrinsics, detections, pairs."""

from __future__ import annotations

from dataclasses import dataclass

#: ROS's topics of transforms end with these words.
TF_TOPICS = ("tf", "tf_static")
TRANSFORM_SCHEMAS = ("foxglove.FrameTransforms", "foxglove.FrameTransform")
INTRINSICS_SCHEMAS = ("sensor_msgs/msg/CameraInfo", "sensor_msgs/CameraInfo", "foxglove.CameraCalibration")
#: In ROS and in Foxglove, the schemas of images that can be decoded end with these words.
IMAGE_SCHEMAS = ("Image", "CompressedImage", "RawImage")
VIDEO_SCHEMAS = ("CompressedVideo",)
#: These schemas are this library's own.
TAG_DETECTIONS = "gtsam_rwhec.TagDetections"
MEASURED_PAIR = "gtsam_rwhec.MeasuredPair"


def schema_word(schema: str) -> str:
    """The last word of a schema's name, such as ``Image`` of ``sensor_msgs/msg/Image`` and ``foxglove.Image``."""
    return schema.replace("/", ".").rpartition(".")[2]


@dataclass(frozen=True)
class Topic:
    """A topic of a log.

    Attributes
    ----------
    first_ns, last_ns : int or None
        First and last log time. If the file has an index, they are the times of the chunks that have the topic.
    unreadable : str
        Why the messages cannot become records; the text is empty if they can.
    """

    name: str
    schema: str
    encoding: str
    count: int
    first_ns: int | None
    last_ns: int | None
    unreadable: str

    @property
    def is_tf(self) -> bool:
        """Whether the topic has transforms of the log's tree of frames."""
        return self.name.rpartition("/")[2] in TF_TOPICS or self.schema in TRANSFORM_SCHEMAS

    @property
    def has_images(self) -> bool:
        """Whether its messages are images that can be decoded."""
        return schema_word(self.schema) in IMAGE_SCHEMAS
