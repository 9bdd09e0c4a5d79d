"""Names of topics and schemas by their content: transforms, images, intrinsics, detections, pairs."""

from __future__ import annotations

#: The last words of ROS's topics of transforms.
TF_TOPICS = ("tf", "tf_static")
TRANSFORM_SCHEMAS = ("foxglove.FrameTransforms", "foxglove.FrameTransform")
INTRINSICS_SCHEMAS = ("sensor_msgs/msg/CameraInfo", "sensor_msgs/CameraInfo", "foxglove.CameraCalibration")
#: The last words of the schemas of images that can be decoded, in ROS and in Foxglove.
IMAGE_SCHEMAS = ("Image", "CompressedImage", "RawImage")
VIDEO_SCHEMAS = ("CompressedVideo",)
#: This library's own schemas.
TAG_DETECTIONS = "gtsam_rwhec.TagDetections"
MEASURED_PAIR = "gtsam_rwhec.MeasuredPair"


def schema_word(schema: str) -> str:
    """The last word of a schema's name: ``Image`` of ``sensor_msgs/msg/Image`` and of ``foxglove.Image``."""
    return schema.replace("/", ".").rpartition(".")[2]
