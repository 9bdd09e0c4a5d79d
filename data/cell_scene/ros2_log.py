"""A ROS 2 log (CDR) of compressed images, camera infos and transforms, by mcap-ros2-support."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace, TracebackType

import numpy as np
from mcap_ros2.writer import Writer
from scipy.spatial.transform import Rotation

from cell_scene.rendering import FloatArray, Lens

#: The lens models in ROS's words.
MODELS = {"radtan": "plumb_bob", "equidistant": "equidistant"}

_HEADER = """
================================================================================
MSG: std_msgs/Header
builtin_interfaces/Time stamp
string frame_id
"""
#: Definitions as a recorder writes them: with all that they use. Time is built in.
_DEFINITIONS = {
    "sensor_msgs/msg/CompressedImage": "std_msgs/Header header\nstring format\nuint8[] data" + _HEADER,
    "sensor_msgs/msg/CameraInfo": (
        "std_msgs/Header header\nuint32 height\nuint32 width\nstring distortion_model\nfloat64[] d\nfloat64[9] k\n"
        "float64[9] r\nfloat64[12] p\nuint32 binning_x\nuint32 binning_y\nRegionOfInterest roi" + _HEADER + "=" * 80
        + "\nMSG: sensor_msgs/RegionOfInterest\nuint32 x_offset\nuint32 y_offset\nuint32 height\nuint32 width\n"
        "bool do_rectify"
    ),
    "tf2_msgs/msg/TFMessage": (
        "geometry_msgs/TransformStamped[] transforms\n" + "=" * 80 + "\nMSG: geometry_msgs/TransformStamped\n"
        "std_msgs/Header header\nstring child_frame_id\nTransform transform" + _HEADER + "=" * 80
        + "\nMSG: geometry_msgs/Transform\nVector3 translation\nQuaternion rotation\n" + "=" * 80
        + "\nMSG: geometry_msgs/Vector3\nfloat64 x\nfloat64 y\nfloat64 z\n" + "=" * 80
        + "\nMSG: geometry_msgs/Quaternion\nfloat64 x 0\nfloat64 y 0\nfloat64 z 0\nfloat64 w 1"
    ),
}  # fmt: skip


class Ros2Log:
    """Writes one file; a context manager."""

    def __init__(self, path: Path) -> None:
        self._stream = open(path, "wb")  # noqa: SIM115  (closed by __exit__)
        self._writer = Writer(self._stream)
        self._schemas = {name: self._writer.register_msgdef(name, text) for name, text in _DEFINITIONS.items()}

    def __enter__(self) -> Ros2Log:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._writer.finish()
        self._stream.close()

    def image(self, topic: str, stamp_ns: int, frame: str, jpeg: bytes) -> None:
        """Write a sensor_msgs/CompressedImage."""
        message = SimpleNamespace(header=_header(stamp_ns, frame), format="jpeg", data=jpeg)
        self._write(topic, "sensor_msgs/msg/CompressedImage", stamp_ns, message)

    def camera_info(self, topic: str, stamp_ns: int, frame: str, lens: Lens) -> None:
        """Write a sensor_msgs/CameraInfo."""
        message = SimpleNamespace(
            header=_header(stamp_ns, frame),
            height=lens.height,
            width=lens.width,
            distortion_model=MODELS[lens.model],
            d=[float(value) for value in lens.coefficients()],
            k=lens.K.ravel().tolist(),
            r=np.eye(3).ravel().tolist(),
            p=np.c_[lens.K, np.zeros(3)].ravel().tolist(),
            binning_x=0,
            binning_y=0,
            roi=SimpleNamespace(x_offset=0, y_offset=0, height=0, width=0, do_rectify=False),
        )
        self._write(topic, "sensor_msgs/msg/CameraInfo", stamp_ns, message)

    def transforms(self, topic: str, stamp_ns: int, transforms: list[tuple[str, str, FloatArray]]) -> None:
        """Write a tf2_msgs/TFMessage of (parent, child, T_parent_child)."""
        parts = []
        for parent, child, T in transforms:
            x, y, z, w = Rotation.from_matrix(T[:3, :3]).as_quat().tolist()
            moved = dict(zip("xyz", T[:3, 3].tolist(), strict=True))
            transform = SimpleNamespace(
                translation=SimpleNamespace(**moved), rotation=SimpleNamespace(x=x, y=y, z=z, w=w)
            )
            parts.append(SimpleNamespace(header=_header(stamp_ns, parent), child_frame_id=child, transform=transform))
        self._write(topic, "tf2_msgs/msg/TFMessage", stamp_ns, SimpleNamespace(transforms=parts))

    def _write(self, topic: str, name: str, stamp_ns: int, message: SimpleNamespace) -> None:
        self._writer.write_message(topic, self._schemas[name], message, log_time=stamp_ns, publish_time=stamp_ns)


def _header(stamp_ns: int, frame: str) -> SimpleNamespace:
    stamp = SimpleNamespace(sec=stamp_ns // 10**9, nanosec=stamp_ns % 10**9)
    return SimpleNamespace(stamp=stamp, frame_id=frame)
