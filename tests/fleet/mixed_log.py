"""A log of small topics that a rig needs beside large ones that it does not, in chunks as recorders write them."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
from mcap.writer import CompressionType, IndexType
from mcap.writer import Writer as McapWriter

#: What the rig needs.
TOPICS = ("/tf", "/detections")


def write_mixed_log(
    path: Path, seconds: int = 40, large_bytes: int = 200_000, index: IndexType = IndexType.ALL, seed: int = 0
) -> int:
    """Write tf and detections at 20 Hz and a camera at 10 Hz with `large_bytes` an image; the bytes of the file.

    The small topics come in bursts, as recorders with a buffer for each topic write them: some chunks have them, most
    have images alone.
    """
    random = np.random.default_rng(seed)
    with open(path, "wb") as stream:
        writer = McapWriter(stream, chunk_size=300_000, compression=CompressionType.ZSTD, index_types=index)
        writer.start(profile="", library="test")
        channels = {
            topic: writer.register_channel(topic, "json", writer.register_schema(schema, "jsonschema", b"{}"))
            for topic, schema in (
                ("/tf", "foxglove.FrameTransforms"), ("/detections", "Numbers"), ("/camera", "Image"),
                ("/static", "foxglove.FrameTransform"),
            )
        }  # fmt: skip
        writer.add_message(channels["/static"], 0, b'{"n": 0}', 0)
        for second in range(seconds):
            for i in range(10):
                stamp = (second * 10 + i) * 10**8
                writer.add_message(channels["/camera"], stamp, random.bytes(large_bytes), stamp)
            if second % 10 == 9:
                for i in range(200):
                    stamp = second * 10**9 + i * 10**6
                    for topic in TOPICS:
                        data = json.dumps({"n": second * 1000 + i, "at": random.normal(size=40).tolist()}).encode()
                        writer.add_message(channels[topic], stamp, data, stamp)
        writer.add_metadata("gtsam_rwhec.rig", {"text": "rig"})
        writer.add_metadata("other", {"text": "x" * 100_000})
        writer.finish()
    return path.stat().st_size
