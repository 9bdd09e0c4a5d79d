"""ROS 2 messages in CDR, by the definitions of ROS's packages or by one in the input.

An input is the number of a schema (one byte), the number of messages after it (one byte), and the messages, all of one
length. With the first bit of the first byte, a definition and a null byte stand before the messages.
"""

from __future__ import annotations

import random
from collections.abc import Callable, Iterable
from pathlib import Path

from harness import Harness, check_said, scratch
from log_files import definition
from mutations import numbers_in_bytes
from seed_messages import ROS2, encoded

from gtsam_rwhec.files.budgets import Spending
from gtsam_rwhec.logs.ros2_messages import ros2_decoder

NAMES = sorted(ROS2)
DEFINITIONS = [definition(name) for name in NAMES]
OWN = 0x80
LINES = (
    "string[] s", "uint8[] data", "float64[9] k", "Point[] p", "wstring w", "uint8[0] none", "uint8[999999999] all",
    "geometry_msgs/Pose[3] poses", "string<=5[<=3] b", "int32 X=1", "MSG: geometry_msgs/Pose", "=" * 80, "T t",
    "std_msgs/Header header", "Header[] headers", "string[1000] many", "int64 id", "bool b", "Empty[100000] e",
)  # fmt: skip


def read(data: bytes) -> None:
    """Records of every message, or sentences; both can be printed."""
    if len(data) < 3:
        return
    number, count, rest = data[0] & ~OWN, 1 + data[1] % 8, data[2:]
    text = DEFINITIONS[number % len(NAMES)]
    if data[0] & OWN:
        own, _, rest = rest.partition(b"\0")
        text = own.decode(errors="replace")
    take = Spending(Path("a.mcap"), len(data)).take_parts
    decode = ros2_decoder(NAMES[number % len(NAMES)], text, take)
    length = len(rest) // count
    messages = [memoryview(rest)[i * length : (i + 1) * length] for i in range(count)]
    check_said(decode("/topic", messages, list(range(count))))


def mutate(data: bytes, chance: random.Random, plain: Callable[[bytes], bytes]) -> bytes:
    """Change numbers in the messages, or lines of the definition."""
    if not (len(data) > 2 and data[0] & OWN) or chance.random() < 0.5:
        return data[:2] + numbers_in_bytes(data[2:], chance, plain)
    text, _, rest = data[2:].partition(b"\0")
    lines = text.split(b"\n")
    at = chance.randrange(len(lines))
    kind = chance.randrange(4)
    if kind == 0:
        del lines[at]
    elif kind == 1:
        lines[at] = chance.choice(LINES).encode()
    elif kind == 2:
        lines.insert(at, chance.choice(LINES).encode())
    else:
        other = chance.randrange(len(lines))
        lines[at], lines[other] = lines[other], lines[at]
    return data[:2] + b"\n".join(lines) + b"\0" + rest


def seeds() -> Iterable[bytes]:
    """A message of each schema, alone and twice, with the known and with its own definition."""
    folder = scratch()
    for i, name in enumerate(NAMES):
        message = encoded(name, folder)
        yield bytes([i, 0]) + message
        yield bytes([i, 1]) + message * 2
        yield bytes([i | OWN, 0]) + DEFINITIONS[i].encode() + b"\0" + message


HARNESS = Harness(read, seeds, mutate)
