"""Small logs, made with the formats' own libraries."""

from __future__ import annotations

import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any

from google.protobuf import descriptor_pb2, descriptor_pool, message_factory, timestamp_pb2
from mcap.writer import CompressionType
from mcap.writer import Writer as McapWriter
from mcap_ros2.writer import Writer as Ros2Writer

PARTS = {
    "std_msgs/Header": "builtin_interfaces/Time stamp\nstring frame_id",
    "geometry_msgs/Point": "float64 x\nfloat64 y\nfloat64 z",
    "geometry_msgs/Vector3": "float64 x\nfloat64 y\nfloat64 z",
    "geometry_msgs/Quaternion": "float64 x 0\nfloat64 y 0\nfloat64 z 0\nfloat64 w 1",
    "geometry_msgs/Pose": "Point position\nQuaternion orientation",
    "geometry_msgs/Transform": "Vector3 translation\nQuaternion rotation",
    "geometry_msgs/Twist": "Vector3 linear\nVector3 angular",
    "geometry_msgs/PoseWithCovariance": "Pose pose\nfloat64[36] covariance",
    "geometry_msgs/TwistWithCovariance": "Twist twist\nfloat64[36] covariance",
    "geometry_msgs/PoseStamped": "std_msgs/Header header\nPose pose",
    "geometry_msgs/PoseWithCovarianceStamped": "# with noise\nstd_msgs/Header header\nPoseWithCovariance pose",
    "geometry_msgs/TransformStamped": "std_msgs/Header header\nstring child_frame_id\nTransform transform",
    "tf2_msgs/TFMessage": "geometry_msgs/TransformStamped[] transforms",
    "nav_msgs/Odometry": (
        "std_msgs/Header header\nstring child_frame_id\n"
        "geometry_msgs/PoseWithCovariance pose\ngeometry_msgs/TwistWithCovariance twist"
    ),
    "sensor_msgs/Image": (
        "std_msgs/Header header\nuint32 height\nuint32 width\nstring encoding\n"
        "uint8 is_bigendian\nuint32 step\nuint8[] data"
    ),
    "sensor_msgs/CompressedImage": "std_msgs/Header header\nstring format\nuint8[] data",
    "sensor_msgs/RegionOfInterest": ("uint32 x_offset\nuint32 y_offset\nuint32 height\nuint32 width\nbool do_rectify"),
    "sensor_msgs/CameraInfo": (
        "std_msgs/Header header\nuint32 height\nuint32 width\nstring distortion_model\nfloat64[] d\nfloat64[9] k\n"
        "float64[9] r\nfloat64[12] p\nuint32 binning_x\nuint32 binning_y\nRegionOfInterest roi"
    ),
    "apriltag_msgs/Point": "float64 x\nfloat64 y",
    "apriltag_msgs/AprilTagDetection": (
        "string family\nint32 id\nint32 hamming\nfloat32 goodness\nfloat32 decision_margin\nPoint centre\n"
        "Point[4] corners\nfloat64[9] homography"
    ),
    "apriltag_msgs/AprilTagDetectionArray": "std_msgs/Header header\nAprilTagDetection[] detections",
    "ros2_aruco_interfaces/ArucoMarkers": "std_msgs/Header header\nint64[] marker_ids\ngeometry_msgs/Pose[] poses",
    "isaac_ros_apriltag_interfaces/AprilTagDetection": (
        "string family\nint32 id\ngeometry_msgs/Point center\ngeometry_msgs/Point[4] corners\n"
        "geometry_msgs/PoseWithCovarianceStamped pose"
    ),
    "isaac_ros_apriltag_interfaces/AprilTagDetectionArray": "std_msgs/Header header\nAprilTagDetection[] detections",
    "aruco_msgs/Marker": (
        "std_msgs/Header header\nuint32 id\ngeometry_msgs/PoseWithCovariance pose\nfloat64 confidence"
    ),
    "aruco_msgs/MarkerArray": "std_msgs/Header header\nMarker[] markers",
    "aruco_opencv_msgs/MarkerPose": "uint16 marker_id\ngeometry_msgs/Pose pose",
    "aruco_opencv_msgs/BoardPose": "string board_name\ngeometry_msgs/Pose pose",
    "aruco_opencv_msgs/ArucoDetection": "std_msgs/Header header\nMarkerPose[] markers\nBoardPose[] boards",
    "std_msgs/String": "string data",
}


def definition(name: str) -> str:
    """A message's definition with all that it uses, as ROS 2 bags carry it."""
    text, todo, done = PARTS[name], [name], {name}
    while todo:
        owner = todo.pop()
        for line in PARTS[owner].splitlines():
            word = line.split(" ")[0].split("[")[0]
            part = word if "/" in word else f"{owner.split('/')[0]}/{word}"
            if part in PARTS and part not in done:
                done.add(part)
                todo.append(part)
                text += f"\n{'=' * 80}\nMSG: {part}\n{PARTS[part]}"
    return text


def space(value: Any) -> Any:
    """Dicts as objects with attributes, which the ROS 2 writer takes."""
    if isinstance(value, dict):
        return SimpleNamespace(**{key: space(part) for key, part in value.items()})
    return [space(part) for part in value] if isinstance(value, list) else value


def header(stamp_ns: int, frame: str = "world") -> dict[str, Any]:
    return {"stamp": {"sec": stamp_ns // 10**9, "nanosec": stamp_ns % 10**9}, "frame_id": frame}


def xyz(*values: float) -> dict[str, float]:
    return dict(zip("xyzw", map(float, values), strict=False))


POSE = {"position": xyz(1, 2, 3), "orientation": xyz(0, 0, 0.6, 0.8)}
TRANSFORM = {"translation": xyz(1, 2, 3), "rotation": xyz(0, 0, 0.6, 0.8)}
#: (topic, schema, message, log time)
Message = tuple[str, str, dict[str, Any], int]


def ros2_log(
    path: Path,
    messages: list[Message],
    compression: CompressionType = CompressionType.ZSTD,
    chunk_size: int = 1 << 20,
    enable_crcs: bool = True,
) -> Path:
    with open(path, "wb") as stream:
        writer = Ros2Writer(stream, chunk_size, compression, enable_crcs)
        schemas = {}
        for topic, name, message, log_time in messages:
            if name not in schemas:
                schemas[name] = writer.register_msgdef(name.replace("/", "/msg/"), definition(name))
            writer.write_message(topic, schemas[name], space(message), log_time=log_time)
        writer.finish()
    return path


def json_log(path: Path, messages: list[Message], **options: Any) -> Path:
    with open(path, "wb") as stream:
        writer = McapWriter(stream, **options)
        writer.start()
        channels: dict[str, int] = {}
        for topic, name, message, log_time in messages:
            if topic not in channels:
                channels[topic] = writer.register_channel(
                    topic, "json", writer.register_schema(name, "jsonschema", b"{}")
                )
            writer.add_message(channels[topic], log_time, json.dumps(message).encode(), log_time)
        writer.finish()
    return path


def foxglove_protobuf() -> dict[str, Any]:
    """Message classes foxglove.FrameTransform, PointCloud and what they use, with Foxglove's names and numbers."""
    double, uint32, string, message, data, enum = 1, 13, 9, 11, 12, 5
    file = descriptor_pb2.FileDescriptorProto(
        name="foxglove/Messages.proto", package="foxglove", syntax="proto3",
        dependency=["google/protobuf/timestamp.proto"],
    )  # fmt: skip
    layouts = {
        "Vector3": [("x", double, ""), ("y", double, ""), ("z", double, "")],
        "Quaternion": [("x", double, ""), ("y", double, ""), ("z", double, ""), ("w", double, "")],
        "FrameTransform": [
            ("timestamp", message, ".google.protobuf.Timestamp"),
            ("parent_frame_id", string, ""),
            ("child_frame_id", string, ""),
            ("translation", message, ".foxglove.Vector3"),
            ("rotation", message, ".foxglove.Quaternion"),
        ],
        "Pose": [("position", message, ".foxglove.Vector3"), ("orientation", message, ".foxglove.Quaternion")],
        "PackedElementField": [("name", string, ""), ("offset", uint32, ""), ("type", enum, "")],
        "PointCloud": [
            ("timestamp", message, ".google.protobuf.Timestamp"),
            ("frame_id", string, ""),
            ("pose", message, ".foxglove.Pose"),
            ("point_stride", uint32, ""),
            ("fields", message, ".foxglove.PackedElementField"),
            ("data", data, ""),
        ],
    }
    for name, fields in layouts.items():
        made = file.message_type.add(name=name)
        for number, (field, type_, type_name) in enumerate(fields, start=1):
            label = 3 if field == "fields" else 1  # repeated, optional
            made.field.add(name=field, number=number, label=label, type=type_, type_name=type_name or None)
    pool = descriptor_pool.DescriptorPool()
    pool.AddSerializedFile(timestamp_pb2.DESCRIPTOR.serialized_pb)
    pool.Add(file)
    return {name: message_factory.GetMessageClass(pool.FindMessageTypeByName(f"foxglove.{name}")) for name in layouts}
