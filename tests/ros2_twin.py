"""The shipped log, or its beginning, as Foxglove JSON and as a ROS 2 bag: the same images, numbers and times."""

from __future__ import annotations

import base64
import json
from collections import Counter
from pathlib import Path
from types import SimpleNamespace
from typing import Any

from mcap.reader import make_reader
from mcap.writer import Writer as McapWriter
from mcap_ros2.writer import Writer as Ros2Writer
from places import CELL


def write_twins(json_path: Path, ros2_path: Path, images: int) -> None:
    """Write both, with the first `images` of each camera."""
    count: Counter[str] = Counter()
    with (
        open(CELL / "robot_cell.mcap", "rb") as source,
        open(CELL / "eye_to_hand.mcap", "rb") as definitions,
        open(json_path, "wb") as json_stream,
        open(ros2_path, "wb") as ros2_stream,
    ):
        summary = make_reader(definitions).get_summary()
        assert summary is not None
        texts = {schema.name: schema.data.decode() for schema in summary.schemas.values()}
        json_out, ros2_out = McapWriter(json_stream), Ros2Writer(ros2_stream)
        json_out.start()
        ros2_schemas = {name: ros2_out.register_msgdef(name, text) for name, text in texts.items()}
        channels: dict[str, int] = {}
        for schema, channel, message in make_reader(source).iter_messages():
            assert schema is not None
            count[channel.topic] += 1
            if schema.name == "foxglove.CompressedImage" and count[channel.topic] > images:
                continue
            if channel.topic not in channels:
                schema_id = json_out.register_schema(schema.name, schema.encoding, schema.data)
                channels[channel.topic] = json_out.register_channel(channel.topic, "json", schema_id)
            json_out.add_message(channels[channel.topic], message.log_time, message.data, message.publish_time)
            name, twin = _TWINS[schema.name](json.loads(message.data))
            ros2_out.write_message(channel.topic, ros2_schemas[name], twin, log_time=message.log_time)
        json_out.finish()
        ros2_out.finish()


def _header(time: dict[str, int], frame: str) -> Any:
    return SimpleNamespace(stamp=SimpleNamespace(sec=time["sec"], nanosec=time["nsec"]), frame_id=frame)


def _image(message: dict[str, Any]) -> tuple[str, Any]:
    header = _header(message["timestamp"], message["frame_id"])
    data = base64.b64decode(message["data"])
    return "sensor_msgs/msg/CompressedImage", SimpleNamespace(header=header, format=message["format"], data=data)


def _calibration(message: dict[str, Any]) -> tuple[str, Any]:
    return "sensor_msgs/msg/CameraInfo", SimpleNamespace(
        header=_header(message["timestamp"], message["frame_id"]),
        height=message["height"],
        width=message["width"],
        distortion_model=message["distortion_model"],
        d=message["D"],
        k=message["K"],
        r=message["R"],
        p=message["P"],
        binning_x=0,
        binning_y=0,
        roi=SimpleNamespace(x_offset=0, y_offset=0, height=0, width=0, do_rectify=False),
    )


def _transforms(message: dict[str, Any]) -> tuple[str, Any]:
    return "tf2_msgs/msg/TFMessage", SimpleNamespace(
        transforms=[
            SimpleNamespace(
                header=_header(part["timestamp"], part["parent_frame_id"]),
                child_frame_id=part["child_frame_id"],
                transform=SimpleNamespace(
                    translation=SimpleNamespace(**part["translation"]), rotation=SimpleNamespace(**part["rotation"])
                ),
            )
            for part in message["transforms"]
        ]
    )


_TWINS = {
    "foxglove.CompressedImage": _image,
    "foxglove.CameraCalibration": _calibration,
    "foxglove.FrameTransforms": _transforms,
}
