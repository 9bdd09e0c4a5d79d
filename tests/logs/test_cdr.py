"""Definitions and bytes of ROS 2 messages, beyond what ROS's own need."""

from __future__ import annotations

import struct
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from mcap.reader import make_reader
from mcap_ros2.writer import Writer
from strategies import cdr_messages, definitions

from gtsam_rwhec.errors import MessageError
from gtsam_rwhec.logs.cdr import Batch, MessageType

DEFINITION = """# every kind of field
uint8 LIMIT=7
string NAME = "a # b"
bool flag
int16[] numbers
string<=10[<=3] words
Inner[2] pair
float32 value 1.5
================================================================================
MSG: my_msgs/Inner
uint8 small
float64[<=4] wide
"""


def encoded(tmp_path: Path, message: Any) -> bytes:
    path = tmp_path / "a.mcap"
    with open(path, "wb") as stream, Writer(stream) as writer:
        writer.write_message("/a", writer.register_msgdef("my_msgs/msg/Outer", DEFINITION), message, log_time=0)
    with open(path, "rb") as stream:
        ((_, _, written),) = make_reader(stream).iter_messages()
    return written.data


def test_every_kind_of_field(tmp_path: Path) -> None:
    inner = [SimpleNamespace(small=1, wide=[1.5, 2.5]), SimpleNamespace(small=2, wide=[])]
    message = SimpleNamespace(flag=True, numbers=[-1, 2, 300], words=["one", "", "drei"], pair=inner, value=0.25)
    ((places, batch),) = MessageType("my_msgs/msg/Outer", DEFINITION).batches([encoded(tmp_path, message)] * 3)
    assert places == [0, 1, 2]
    assert isinstance(batch, Batch)
    tree = batch.shape.tree
    assert tree["words"] == ["one", "", "drei"]
    np.testing.assert_array_equal(batch.numbers(tree, "numbers"), [[-1, 2, 300]] * 3)
    np.testing.assert_array_equal(batch.numbers(tree["pair"][0], "wide"), [[1.5, 2.5]] * 3)
    assert batch.numbers(tree["pair"][1], "wide").shape == (3, 0)
    assert batch.numbers(tree["pair"][1], "small").tolist() == [2, 2, 2]
    assert batch.numbers(tree, "value").tolist() == [0.25] * 3


def test_big_endian_and_xcdr2() -> None:
    definition = "uint8 a\nfloat64 b"
    padded = {0: ">", 1: "<", 6: ">", 7: "<"}
    for kind, order in padded.items():
        gap = 7 if kind < 6 else 3
        message = bytes([0, kind, 0, 0, 5]) + bytes(gap) + struct.pack(order + "d", 2.5)
        ((_, batch),) = MessageType("m/T", definition).batches([message])
        assert isinstance(batch, Batch)
        assert batch.numbers(batch.shape.tree, "b").tolist() == [2.5]


@pytest.mark.parametrize(
    ("definition", "words"),
    [
        ("", "no definition of its fields"),
        ("7 dwarfs", "cannot read the line"),
        ("wstring w", "wide strings"),
        (f"uint8[{'9' * 5000}] x", "cannot read the line"),
    ],
)
def test_definitions_that_cannot_be_read(definition: str, words: str) -> None:
    with pytest.raises(MessageError, match=words):
        MessageType("my_msgs/T", definition)


@pytest.mark.parametrize(
    ("definition", "content", "words"),
    [
        ("T t", bytes(99), "deep"),
        ("Unknown u", bytes(99), "no definition of m/Unknown"),
        ("Empty[] e\n====\nMSG: m/Empty\n", b"\xff" * 200_000, "a list of 4294967295 m/Empty; at most 100000"),
        ("uint8[] x", b"\xff\xff\xff\xff", "ends after 8 bytes"),
        ("string s", b"\x02\0\0\0\xff\0", "not UTF-8"),
    ],
)
def test_messages_that_cannot_be_read(definition: str, content: bytes, words: str) -> None:
    ((_, error),) = MessageType("m/T", definition).batches([b"\0\1\0\0" + content])
    assert isinstance(error, MessageError)
    assert any(word in str(error) for word in words.split("|")), error


@given(definition=st.text(max_size=60) | definitions, content=st.binary(max_size=60) | cdr_messages)
def test_any_definition_and_bytes(definition: str, content: bytes) -> None:
    try:
        message_type = MessageType("m/T", definition)
    except MessageError:
        return
    for _, batch in message_type.batches([b"\0\1\0\0" + content, content]):
        assert isinstance(batch, Batch | MessageError)
