"""ROS 1 and db3 bags that were made to exhaust their reader: each is refused within its budget; honest ones convert."""

from __future__ import annotations

import bz2
import sqlite3
import struct
from collections.abc import Callable
from contextlib import closing
from pathlib import Path

import lz4.frame
import pytest
import zstandard
from limited_process import MEMORY, SECONDS, Reader

from gtsam_rwhec.logs.ros_bags import MEMORY_FOR_A_BYTE

MIB = 1 << 20
#: Bytes of the process before it reads anything.
IMPORTS = 100 * MIB
COMPRESS: dict[str, Callable[[bytes], bytes]] = {"none": bytes, "bz2": bz2.compress, "lz4": lz4.frame.compress}
STRING = "string data"


def record(data: bytes, **fields: bytes | int) -> bytes:
    packed = b""
    for name, value in fields.items():
        entry = name.encode() + b"=" + (bytes([value]) if isinstance(value, int) else value)
        packed += struct.pack("<I", len(entry)) + entry
    return struct.pack("<I", len(packed)) + packed + struct.pack("<I", len(data)) + data


def number(value: int, code: str = "I") -> bytes:
    return struct.pack(f"<{code}", value)


def text(value: bytes) -> bytes:
    return number(len(value)) + value


def connection(definition: str = STRING) -> bytes:
    entries = b"".join(
        text(key + b"=" + value)
        for key, value in (
            (b"topic", b"/a"), (b"type", b"std_msgs/String"), (b"md5sum", b""),
            (b"message_definition", definition.encode()),
        )
    )  # fmt: skip
    return record(entries, op=7, conn=number(0), topic=b"/a")


def message(data: bytes, time: int = 0) -> bytes:
    return record(data, op=2, conn=number(0), time=struct.pack("<II", time, 0))


def chunk(data: bytes, compression: str = "lz4", *, stated: int | None = None) -> bytes:
    size = len(data) if stated is None else stated
    return record(COMPRESS[compression](data), op=5, compression=compression.encode(), size=number(size))


def index(entries: list[tuple[int, int]]) -> bytes:
    data = b"".join(struct.pack("<III", time, 0, place) for time, place in entries)
    # `rosbags` reads the fields where they are in its own order.
    return record(data, ver=number(1), conn=number(0), count=number(len(entries)), op=4)


def chunk_info(at: int, count: int) -> bytes:
    times = {"start_time": bytes(8), "end_time": bytes(8)}
    head = {"op": 6, "ver": number(1), "chunk_pos": number(at, "Q"), **times, "count": number(1)}
    return record(number(0) + number(count), **head)


def bag(chunks: list[tuple[bytes, list[tuple[int, int]]]], *, definition: str = STRING, listed: int = 1) -> bytes:
    """A bag of chunks with their index; each chunk is listed a number of times."""
    magic = b"#ROSBAG V2.0\n"

    def head(at: int, count: int) -> bytes:
        return record(b"", op=3, index_pos=number(at, "Q"), conn_count=number(1), chunk_count=number(count))

    data, places = magic + head(0, 0), []
    for content, entries in chunks:
        places.append((len(data), len(entries)))
        data += content + index(entries)
    infos = [chunk_info(at, count) for at, count in places for _ in range(listed)]
    return (
        magic + head(len(data), len(infos)) + data[len(magic + head(0, 0)) :] + connection(definition) + b"".join(infos)
    )


def one_message(data: bytes, compression: str = "lz4", **options: object) -> bytes:
    stated = options.pop("stated", None)
    return bag([(chunk(message(data), compression, stated=stated), [(0, 0)])], **options)  # type: ignore[arg-type]


def turns(count: int) -> bytes:
    """Two large chunks whose messages take turns: each is opened anew for each message."""
    data = b"".join(message(text(b"x"), i) for i in range(count)) + message(text(bytes(20 * MIB)), 0)
    length = len(message(text(b"x")))
    both = [(chunk(data), [(2 * i + k, i * length) for i in range(count)]) for k in range(2)]
    return bag(both)


def connections_between(count: int) -> bytes:
    """Each message's place in the index is before a long row of connections."""
    data = connection() * count + message(text(b"x"))
    return bag([(chunk(data), [(0, 0)] * 1000)])


LINES = "\n".join(f"float64 a{i}" for i in range(20_000))
ROS1: dict[str, Callable[[], bytes]] = {
    "lz4": lambda: one_message(text(bytes(300 * MIB))),
    "bz2": lambda: one_message(text(bytes(300 * MIB)), "bz2"),
    "lz4 that states less": lambda: one_message(text(bytes(300 * MIB)), stated=1000),
    "lz4 that states more": lambda: one_message(b"", stated=20 * MIB),
    "many bz2": lambda: bag([(chunk(message(text(bytes(20 * MIB))), "bz2"), [(0, 0)])] * 60),
    "chunk listed often": lambda: bag([(chunk(message(text(b"x")), "none"), [(0, 0)] * 10_000)], listed=1000),
    "chunks that take turns": lambda: turns(2000),
    "connections between": lambda: connections_between(5000),
    "record of 4 GB": lambda: one_message(b"")[:-200] + b"\xff" * 200,
    "long definition": lambda: one_message(text(b"x"), definition=LINES),
    "fixed list of strings": lambda: one_message(b"", definition="string[99999999] s"),
    "list of empty messages": lambda: one_message(
        number(2**32 - 1), definition="E[] s\n" + "=" * 80 + "\nMSG: std_msgs/E\n"
    ),
    "list of numbers": lambda: one_message(number(2**32 - 1), definition="float64[] s"),
    "itself": lambda: one_message(bytes(99), definition="String s"),
    "empty records": lambda: bag([(chunk(record(b"", op=9) * (20 * MIB // 16)), [])]),
}

SCHEMA = "CREATE TABLE schema(schema_version INTEGER, ros_distro TEXT); INSERT INTO schema VALUES (4, 'rolling');"
TABLES = f"""
{SCHEMA}
CREATE TABLE message_definitions(id INTEGER PRIMARY KEY, topic_type TEXT, encoding TEXT,
    encoded_message_definition TEXT, type_description_hash TEXT);
"""
TOPICS = """
CREATE TABLE topics(id INTEGER, name TEXT, type TEXT, serialization_format TEXT, offered_qos_profiles TEXT,
    type_description_hash TEXT);
"""
MESSAGES = "CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER, timestamp INTEGER, data BLOB);"
TOPIC = "INSERT INTO topics VALUES (1, '/a', 'std_msgs/msg/String', 'cdr', '', '');"
DEFINED = f"INSERT INTO message_definitions VALUES (1, 'std_msgs/msg/String', 'ros2msg', '{STRING}', '');"
#: A schema that never ends to be counted.
ENDLESS = """CREATE VIEW schema(schema_version) AS
    WITH RECURSIVE n(i) AS (SELECT 1 UNION ALL SELECT i + 1 FROM n) SELECT sum(i) FROM n;"""
REDEFINED = f"UPDATE message_definitions SET encoded_message_definition = '{LINES}';"
HONEST_DB3 = TABLES + TOPICS + MESSAGES + TOPIC + DEFINED
METADATA = """rosbag2_bagfile_information:
  version: 9
  storage_identifier: sqlite3
  duration: {{nanoseconds: 0}}
  starting_time: {{nanoseconds_since_epoch: 0}}
  message_count: 1
  topics_with_message_count:
    - topic_metadata: {{name: /a, type: std_msgs/msg/String, serialization_format: cdr, offered_qos_profiles: []}}
      message_count: 1
  compression_format: '{format}'
  compression_mode: '{mode}'
  relative_file_paths: [{file}]
"""


def db3(folder: Path, script: str, rows: list[bytes] | None = None) -> Path:
    path = folder / "a.db3"
    with closing(sqlite3.connect(path)) as database:
        database.executescript(f"BEGIN; {script} COMMIT;")
        if rows:
            database.executemany("INSERT INTO messages VALUES (NULL, 1, 0, ?)", [(row,) for row in rows])
        database.commit()
    return path


def in_a_folder(folder: Path, file: str, mode: str = "") -> Path:
    (folder / "metadata.yaml").write_text(METADATA.format(file=file, mode=mode, format="zstd" if mode else ""))
    return folder


def compressed_file(folder: Path) -> Path:
    (folder / "a.db3.zstd").write_bytes(zstandard.compress(bytes(1024 * MIB)))
    return in_a_folder(folder, "a.db3.zstd", "FILE")


def compressed_messages(folder: Path) -> Path:
    db3(folder, HONEST_DB3, [zstandard.compress(bytes(256 * MIB))])
    return in_a_folder(folder, "a.db3", "MESSAGE")


def long_metadata(folder: Path) -> Path:
    db3(folder, HONEST_DB3)
    bag_ = in_a_folder(folder, "a.db3")
    with open(bag_ / "metadata.yaml", "a") as stream:
        stream.write("x: [" + "[a], " * 30_000 + "]\n")
    return bag_


def mcap_bag(folder: Path) -> Path:
    (folder / "a.mcap").write_bytes(b"\x89MCAP0\r\n")
    return in_a_folder(folder, "a.mcap")


def computed(data: str) -> str:
    return HONEST_DB3.replace("data BLOB", f"data BLOB AS ({data})") + "INSERT INTO messages VALUES (1, 1, 0);"


DB3: dict[str, Callable[[Path], Path]] = {
    "computed column": lambda folder: db3(folder, computed("zeroblob(900000000)")),
    "endless view": lambda folder: db3(folder, HONEST_DB3.replace(SCHEMA, ENDLESS)),
    "one topic thousands of times": lambda folder: db3(
        folder, HONEST_DB3 + TOPIC * 3000, [b"\0\1\0\0" + text(b"x\0")] * 3000
    ),
    "long definition": lambda folder: db3(folder, HONEST_DB3 + REDEFINED),
    "compressed file": compressed_file,
    "compressed message": compressed_messages,
    "long metadata": long_metadata,
    "mcap": mcap_bag,
}
#: What costs no more than an honest bag is converted.
HARMLESS = ("empty records", "long metadata")


def refused(reader: Reader, path: Path, size: int, name: str) -> None:
    reading = reader("bag", path)
    assert reading.error == ("" if name in HARMLESS else "LogError"), (reading.error, reading.message)
    assert reading.peak_bytes <= MEMORY + size
    assert reading.children_peak_bytes <= IMPORTS + MEMORY + MEMORY_FOR_A_BYTE * size
    assert reading.seconds <= SECONDS


@pytest.mark.parametrize("name", ROS1)
def test_a_hostile_ros_1_bag_is_refused_within_its_budget(reader: Reader, tmp_path: Path, name: str) -> None:
    path = tmp_path / "a.bag"
    path.write_bytes(ROS1[name]())
    refused(reader, path, path.stat().st_size, name)


@pytest.mark.parametrize("name", DB3)
def test_a_hostile_db3_bag_is_refused_within_its_budget(reader: Reader, tmp_path: Path, name: str) -> None:
    path = DB3[name](tmp_path)
    refused(reader, path, sum(file.stat().st_size for file in tmp_path.iterdir()), name)


@pytest.mark.parametrize("compression", list(COMPRESS))
def test_an_honest_ros_1_bag_is_converted(reader: Reader, tmp_path: Path, compression: str) -> None:
    """Twenty chunks of text that repeats, each with a thousand messages."""
    chunks = []
    for first in range(0, 20_000, 1000):
        data = [message(text(f"{first + i:08}".encode() * 20), first + i) for i in range(1000)]
        entries = [(first + i, i * len(data[0])) for i in range(1000)]
        chunks.append((chunk(b"".join(data), compression), entries))
    path = tmp_path / "a.bag"
    path.write_bytes(bag(chunks))
    reading = reader("bag", path)
    assert (reading.error, reading.result) == ("", 20_000), reading.message


@pytest.mark.parametrize("mode", ["", "MESSAGE", "FILE"])
def test_an_honest_db3_bag_is_converted(reader: Reader, tmp_path: Path, mode: str) -> None:
    rows = [b"\0\1\0\0" + text(b"hello\0")] * 500
    db3(tmp_path, HONEST_DB3, [zstandard.compress(row) for row in rows] if mode == "MESSAGE" else rows)
    file = "a.db3"
    if mode == "FILE":
        file = "a.db3.zstd"
        (tmp_path / file).write_bytes(zstandard.compress((tmp_path / "a.db3").read_bytes()))
        (tmp_path / "a.db3").unlink()
    reading = reader("bag", in_a_folder(tmp_path, file, mode))
    assert (reading.error, reading.result) == ("", 500), reading.message
