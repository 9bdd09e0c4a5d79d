"""Logs whose messages were made to exhaust their reader, each with the words of its refusal."""

from __future__ import annotations

import struct
from collections.abc import Callable
from itertools import pairwise

from crafted_logs import LITTLE_ENDIAN, MIB, cdr, described
from crafted_mcap import channel, message, schema, text
from log_files import definition, foxglove_protobuf

#: Each message has two lists of two of the next.
NESTED = "m/A a" + "".join(f"\n====\nMSG: m/{a}\n{b}[2] x\n{b}[2] y" for a, b in pairwise("ABCDEFGHIJKLMNO"))
NESTED += "\n====\nMSG: m/O\nuint8[0] z"
#: A message without fields, and one whose field has no bytes.
EMPTY = "\n====\nMSG: geometry_msgs/E\n"
POSE_STAMPED = "geometry_msgs/msg/PoseStamped"


def odd(fields: str) -> str:
    """The definition of a pose with other fields before it."""
    return f"{fields}\n{definition('geometry_msgs/PoseStamped')}"


def transforms_of_many_shapes() -> bytes:
    """Each message has another number of transforms, so each is walked over."""
    one = bytes(8) + text(b"a\0") + bytes(2) + text(b"b\0") + bytes(2) + bytes(7 * 8)
    messages = [message(1, LITTLE_ENDIAN + struct.pack("<I", n) + bytes(4) + one * n, n) for n in range(1, 800)]
    descriptions = schema(1, "tf2_msgs/msg/TFMessage", "ros2msg", definition("tf2_msgs/TFMessage").encode())
    return described(messages, descriptions + channel(1, 1, "/tf", "cdr"))


def long_strings_that_differ() -> bytes:
    texts = [f"{i:06}".encode() + b"x" * 60_000 + b"\0" for i in range(1000)]
    messages = [message(1, LITTLE_ENDIAN + bytes(8) + text(name) + bytes(64), i) for i, name in enumerate(texts)]
    descriptions = schema(1, POSE_STAMPED, "ros2msg", definition("geometry_msgs/PoseStamped").encode())
    return described(messages, descriptions + channel(1, 1, "/pose", "cdr"))


def json_message(content: bytes) -> bytes:
    return described([message(1, content)])


def protobuf(name: str, content: bytes, descriptors: bytes) -> bytes:
    descriptions = schema(1, name, "protobuf", descriptors) + channel(1, 1, "/a", "protobuf")
    return described([message(1, content)], descriptions)


def descriptors_of_poses() -> bytes:
    """foxglove.PosesInFrame, whose poses may be empty."""
    from google.protobuf import descriptor_pb2, timestamp_pb2

    files = descriptor_pb2.FileDescriptorSet()
    files.file.add().ParseFromString(timestamp_pb2.DESCRIPTOR.serialized_pb)
    foxglove_protobuf()["Vector3"].DESCRIPTOR.file.CopyToProto(files.file.add())
    file = files.file.add(name="p.proto", package="foxglove", syntax="proto3")
    file.dependency.extend(["google/protobuf/timestamp.proto", "foxglove/FrameTransform.proto"])
    pose = file.message_type.add(name="Pose")
    pose.field.add(name="position", number=1, label=1, type=11, type_name=".foxglove.Vector3")
    pose.field.add(name="orientation", number=2, label=1, type=11, type_name=".foxglove.Quaternion")
    poses = file.message_type.add(name="PosesInFrame")
    poses.field.add(name="timestamp", number=1, label=1, type=11, type_name=".google.protobuf.Timestamp")
    poses.field.add(name="frame_id", number=2, label=1, type=9)
    poses.field.add(name="poses", number=3, label=3, type=11, type_name=".foxglove.Pose")
    return files.SerializeToString()


def descriptors_without_end() -> bytes:
    from google.protobuf import descriptor_pb2

    files = descriptor_pb2.FileDescriptorSet()
    file = files.file.add(name="a.proto", package="foxglove", syntax="proto3")
    for i in range(20_000):
        file.message_type.add(name=f"M{i}")
    file.message_type.add(name="PosesInFrame")
    return files.SerializeToString()


MESSAGES: dict[str, tuple[Callable[[], bytes], str]] = {
    "string[]": (
        lambda: cdr(POSE_STAMPED, struct.pack("<I", 5 * MIB) + bytes(20 * MIB), odd("string[] s")),
        "a list of 5242880 string; at most 100000",
    ),
    "string[] that lies": (
        lambda: cdr(POSE_STAMPED, struct.pack("<I", 2**32 - 1), odd("string[] s")), "a list of 4294967295 string; at",
    ),
    "string of 4 GB": (lambda: cdr(POSE_STAMPED, b"\xff" * 4, odd("string s")), "ends after 8 bytes"),
    "empty messages": (
        lambda: cdr(POSE_STAMPED, struct.pack("<I", 20 * MIB) + bytes(20 * MIB), odd("E[] s") + EMPTY),
        "a list of 20971520 geometry_msgs/E; at most",
    ),
    "no bytes each": (
        lambda: cdr(POSE_STAMPED, struct.pack("<I", 2**31), odd("E[] s") + EMPTY + "uint8[0] z"),
        "a list of 2147483648 geometry_msgs/E; at most",
    ),
    "fixed list": (
        lambda: cdr(POSE_STAMPED, bytes(20 * MIB), odd("string[4999999] s")), "a list of 4999999 string; at most",
    ),
    "lists in lists": (lambda: cdr(POSE_STAMPED, bytes(MIB), NESTED), "a list of 2 m/O; at most 100000"),
    "itself": (lambda: cdr(POSE_STAMPED, bytes(99), "PoseStamped p"), "more than 16 deep"),
    "list of itself": (
        lambda: cdr(POSE_STAMPED, struct.pack("<I", 1) * 1000, "PoseStamped[] p"), "more than 16 deep",
    ),
    "transforms of many shapes": (transforms_of_many_shapes, "messages, records, numbers and strings"),
    "long strings": (long_strings_that_differ, "norm 0"),
    "deep JSON": (lambda: json_message(b"[" * 20 * MIB), "messages, records, numbers and strings"),
    "shorter JSON list": (lambda: json_message(b'{"a":[' + b"[]," * 60_000 + b"1]}"), "JSON of 120003 numbers"),
    "less deep JSON": (lambda: json_message(b"[" * 90_000), "not JSON: maximum recursion"),
    "long JSON list": (
        lambda: json_message(b'{"a":[' + b"[]," * 7 * MIB + b"1]}"), "messages, records, numbers and strings",
    ),
    "long JSON text": (lambda: json_message(b'{"a":"' + b"x" * 22 * MIB + "\U0001f600".encode() + b'"}'), "in memory"),
    "escaped JSON text": (lambda: json_message(b'{"a":"' + b"x" * 22 * MIB + rb'\ud83d\ude00"}'), "lacks a field"),
    "JSON message": (lambda: json_message(b'{"a":"' + b"x" * 50 * MIB + b'"}'), "a message of"),
    "long JSON number": (lambda: json_message(b'{"a":' + b"9" * 20 * MIB + b"}"), "not JSON: Exceeds the limit"),
    "empty poses of protobuf": (
        lambda: protobuf("foxglove.PosesInFrame", b"\x1a\x00" * 10 * MIB, descriptors_of_poses()), "with lists in them",
    ),
    "fewer empty poses of protobuf": (
        lambda: protobuf("foxglove.PosesInFrame", b"\x1a\x00" * 500_000, descriptors_of_poses()),
        "poses has 500000 entries",
    ),
    "types of protobuf": (
        lambda: protobuf("foxglove.PosesInFrame", b"", descriptors_without_end()), "they define 20001 types",
    ),
    "many messages with a list": (
        lambda: described([message(1, b'{"a":[' + b"1," * 90_000 + b"1]}", i) for i in range(300)]),
        "messages, records, numbers and strings",
    ),
}  # fmt: skip
