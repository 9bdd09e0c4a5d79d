"""Messages in protobuf: the descriptors of the log (their length first, four bytes), then one message."""

from __future__ import annotations

import random
from collections.abc import Callable, Iterable
from pathlib import Path

from harness import Harness
from mcap.records import Channel, Schema
from mcap_protobuf.schema import build_file_descriptor_set
from mutations import numbers_in_bytes
from seed_messages import protobuf_message

from gtsam_rwhec.files.budgets import Spending
from gtsam_rwhec.logs import foxglove_messages as decoders

NAMES = ("foxglove.FrameTransform", "foxglove.FrameTransforms", "foxglove.PoseInFrame", "foxglove.RawImage")


def read(data: bytes) -> None:
    """Records or sentences; both can be printed."""
    if len(data) < 5:
        return
    size = int.from_bytes(data[1:5], "little")
    schema = Schema(id=1, data=data[5 : 5 + size], encoding="protobuf", name=NAMES[data[0] % len(NAMES)])
    channel = Channel(id=1, topic="/a", message_encoding="protobuf", metadata={}, schema_id=1)
    for each in decoders.decoder_for(channel, schema, Spending(Path("a.mcap"), len(data)))(
        "/a", [data[5 + size :]], [0]
    ):
        str(each)


def mutate(data: bytes, chance: random.Random, plain: Callable[[bytes], bytes]) -> bytes:
    """Change the descriptors or the message, and keep the place between them."""
    if len(data) < 5 or chance.random() < 0.05:
        return plain(data)
    size = int.from_bytes(data[1:5], "little")
    schema, message = data[5 : 5 + size], data[5 + size :]
    if chance.random() < 0.5:
        schema = numbers_in_bytes(schema, chance, plain)
    else:
        message = numbers_in_bytes(message, chance, plain)
    return data[:1] + len(schema).to_bytes(4, "little") + schema + message


def seeds() -> Iterable[bytes]:
    """A transform with its descriptors."""
    message = protobuf_message()
    described = build_file_descriptor_set(type(message)).SerializeToString()
    for i in range(len(NAMES)):
        yield bytes([i]) + len(described).to_bytes(4, "little") + described + message.SerializeToString()


HARNESS = Harness(read, seeds, mutate)
