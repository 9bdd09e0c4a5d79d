"""Logs as they are written for the tests of the reader, and what it reads."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from log_files import foxglove_protobuf
from mcap.writer import IndexType
from mcap_protobuf.writer import Writer as ProtobufWriter

from gtsam_rwhec.logs import open_log

T0 = 1_700_000_000_000_000_000
#: of POSE and TRANSFORM: about z, cos = 0.8^2 - 0.6^2
T_EXPECTED = np.array([[0.28, -0.96, 0, 1], [0.96, 0.28, 0, 2], [0, 0, 1, 3], [0, 0, 0, 1.0]])
LOOSE = {"use_chunking": False}
BARE = {
    "index_types": IndexType.NONE, "use_statistics": False, "use_summary_offsets": False,
    "repeat_channels": False, "repeat_schemas": False,
}  # fmt: skip


def read(path: Path, **options: Any) -> list[Any]:
    with open_log(path) as log:
        return list(log.records(**options))


def protobuf_log(path: Path, **options: Any) -> Path:
    classes = foxglove_protobuf()
    message = classes["FrameTransform"](parent_frame_id="base", child_frame_id="hand")
    message.timestamp.FromNanoseconds(T0 + 5)
    message.translation.x, message.translation.y, message.translation.z = 1, 2, 3
    message.rotation.z, message.rotation.w = 0.6, 0.8
    with open(path, "wb") as stream, ProtobufWriter(stream, **options) as writer:
        writer.write_message("/tf", message, log_time=T0, publish_time=T0)
    return path
