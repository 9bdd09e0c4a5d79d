"""ROS 1 bags and ROS 2 db3 bags converted to MCAP by the `rosbags` library (the extra ``gtsam-rwhec[rosbags]``).

ROS 1 messages are encoded as CDR with the same fields and numbers; ROS 2 messages are copied byte for byte. `rosbags`
runs in a process of its own, with limits that grow with the bag (``ros_bag_process.py``).
"""

from __future__ import annotations

import bz2
import errno
import json
import os
import re
import signal
import sqlite3
import stat
import struct
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterable, Iterator
from contextlib import closing
from dataclasses import dataclass, field
from importlib.util import find_spec
from pathlib import Path
from typing import Any, BinaryIO

import lz4.frame
import numpy as np
import zstandard

from gtsam_rwhec.errors import BudgetError, FileFormatError, LogError
from gtsam_rwhec.files.budgets import (
    BAG_DEFINITIONS,
    BAG_DEFINITIONS_SHARE,
    BAG_METADATA,
    BAG_METADATA_SHARE,
    BZ2_BYTES,
    FIXED_LIST,
    Spending,
)
from gtsam_rwhec.files.terminal_text import shown
from gtsam_rwhec.files.whole_files import atomic_stream, checked_path
from gtsam_rwhec.files.yaml_lines import read_yaml

#: Bytes. Reading a bag may take this much memory,
MEMORY = 200 << 20
#: and this many bytes for each byte of the bag: an index entry of 16 bytes becomes an object of 150.
MEMORY_FOR_A_BYTE = 12
#: Bytes. The log that is written, and each file that is decompressed on the way, may have this many,
WRITTEN = 256 << 20
#: and this many for each byte of the bag.
WRITTEN_FOR_A_BYTE = 100
#: Seconds of the processor. Reading a bag may take this long,
TIME_S = 5
#: and this many seconds for each megabyte of the bag. Honest bags of small messages take one or two.
TIME_FOR_A_MEGABYTE_S = 30
#: What ended the process, in words.
_ENDED_BY = {
    signal.SIGXCPU: "it takes more time than a bag of its size may",
    signal.SIGKILL: "it takes more time or memory than a bag of its size may",
    signal.SIGXFSZ: "it decompresses to more than a bag of its size may",
}


def convert_ros_bag(bag: str | Path, path: str | Path) -> int:
    """Write the messages of a ROS 1 ``.bag`` file, or of a ROS 2 bag's folder, as an MCAP file in the order of time.

    A file of this name is replaced once all is written. Returns how many messages there are.

    Raises
    ------
    MissingPackageError
        `rosbags` is not installed.
    LogError
        The bag cannot be read, has no definitions of its messages, or takes more memory or time than a bag of its size
        may; the file cannot be written; or a ROS 2 bag is in MCAP already.
    BudgetError
        The bag states more, or yields more, than one of its size may (``files/budgets.py``).
    """
    bag, path = checked_path(bag), checked_path(path)
    if find_spec("rosbags") is None:
        raise LogError("rosbags is not installed: pip install gtsam-rwhec[rosbags]")
    size = _size(bag)
    # What can be told before `rosbags` reads is told in words; its process only ends.
    if bag.is_dir() or bag.suffix != ".bag":
        check_ros2_bag(bag, Spending(bag, size))
    else:
        check_ros1_bag(bag)
    try:
        with atomic_stream(path) as stream:
            return _converted(bag, size, stream, path)
    except OSError as error:
        raise LogError(f"{path} cannot be written: {error.strerror or error}.") from error


def _size(bag: Path) -> int:
    """Bytes of the bag's files; pipes and devices are refused."""
    try:
        files = sorted(bag.iterdir()) if bag.is_dir() else [bag]
        states = [file.stat() for file in files]
    except OSError as error:
        raise LogError(f"{bag} cannot be read as a ROS bag: {error.strerror}.") from error
    for file, state in zip(files, states, strict=True):
        if not (stat.S_ISREG(state.st_mode) or stat.S_ISDIR(state.st_mode)):
            raise LogError(f"{bag} cannot be read as a ROS bag: {file} is not a file.")
    return sum(state.st_size for state in states)


def _converted(bag: Path, size: int, stream: BinaryIO, path: Path) -> int:
    limits = (
        MEMORY + MEMORY_FOR_A_BYTE * size,
        WRITTEN + WRITTEN_FOR_A_BYTE * size,
        TIME_S + TIME_FOR_A_MEGABYTE_S * size // 1_000_000,
    )
    script = Path(__file__).with_name("ros_bag_process.py")
    # -P: no folder of the caller's comes before the libraries. Threads of BLAS would only reserve memory.
    command = [sys.executable, "-P", str(script), os.path.abspath(bag), *map(str, limits)]
    found_in = os.pathsep.join(folder for folder in sys.path if os.path.isabs(folder))
    with tempfile.TemporaryDirectory() as scratch:  # for what rosbags decompresses; it is emptied however rosbags ends
        environment = {**os.environ, "PYTHONPATH": found_in, "TMPDIR": scratch, "OPENBLAS_NUM_THREADS": "1"}
        ended = subprocess.run(
            command, stdin=subprocess.DEVNULL, stdout=stream, stderr=subprocess.PIPE, env=environment, check=False
        )
    last = ended.stderr.decode(errors="replace").strip().rpartition("\n")[2]
    if ended.returncode == 0:
        told = json.loads(last)
        if "count" in told:
            return int(told["count"])
        if told["errno"] in (errno.ENOSPC, errno.EDQUOT):
            raise LogError(f"{path} cannot be written: {told['refused']}.")
        what = _ENDED_BY[signal.SIGXFSZ] if told["errno"] == errno.EFBIG else shown(told["refused"], 500)
        raise LogError(f"{bag} cannot be read as a ROS bag: {what}.")
    if ended.returncode < 0:
        name = signal.Signals(-ended.returncode)
        raise LogError(f"{bag} cannot be read as a ROS bag: {_ENDED_BY.get(name, f'rosbags ended by {name.name}')}.")
    kind, _, said = last.partition(": ")
    what = said or kind.rpartition(".")[2]
    if kind == "MemoryError":
        what = "it takes more memory than a bag of its size may"
    raise LogError(f"{bag} cannot be read as a ROS bag: {shown(what, 500)}")


_MAGIC = b"#ROSBAG V2.0\n"
_LENGTH = struct.Struct("<I")
#: What the field ``op`` of a record says.
_MESSAGE, _INDEX, _CHUNK, _CHUNK_INFO, _CONNECTION = b"\2", b"\4", b"\5", b"\6", b"\7"
#: Bytes. The fields of a record, without its data, have at most this much.
_LONGEST_HEADER = 1 << 16
#: Connections that stand in a chunk between a message and the place that the index has for it.
_MOST_BETWEEN = 16
#: An index has 12 bytes for each message: seconds, nanoseconds, and the place in the opened chunk.
_ENTRY = np.dtype([("seconds", "<u4"), ("nanoseconds", "<u4"), ("place", "<u4")])
_FAULTS = (struct.error, ValueError, OverflowError)


@dataclass
class _Chunk:
    """A chunk: its number in the file, the size that it states, and the places in it that an index may have."""

    number: int
    size: int
    places: set[int]


@dataclass(frozen=True)
class _Record:
    """A record: where it begins in the file, its fields, and where its data are and how long."""

    begin: int
    fields: dict[bytes, bytes]
    at: int
    length: int


@dataclass
class _Seen:
    """What went by: chunks by their place in the file, times and chunks of messages, definitions."""

    chunks: dict[int, _Chunk] = field(default_factory=dict)
    times: list[np.ndarray] = field(default_factory=list)
    numbers: list[np.ndarray] = field(default_factory=list)
    definitions: list[str] = field(default_factory=list)
    listed: set[int] = field(default_factory=set)


def check_ros1_bag(path: Path) -> None:
    """Refuse a bag that asks for more memory or work than one of its size may: a BudgetError.

    So do chunks that yield too much, an index that lists a chunk twice, and definitions that are too long. A LogError
    says that it cannot be read, or is damaged.
    """
    try:
        with open(path, "rb") as stream:
            size = os.fstat(stream.fileno()).st_size
            spending = Spending(path, size)
            seen = _Seen()
            if stream.read(len(_MAGIC)) != _MAGIC:
                return  # `rosbags` says what it is
            for record in _records(stream, len(_MAGIC), size):
                spending.take_parts(1)
                _note(stream, record, seen, spending)
    except OSError as error:
        raise LogError(f"{path} cannot be read: {error.strerror}.") from error
    except BudgetError:
        raise
    except _FAULTS as error:
        raise LogError(f"{path} cannot be read as a ROS bag: {error}") from error
    check_definitions(seen.definitions, path, size)
    _check_order(seen, spending)


def _records(stream: BinaryIO, at: int, end: int) -> Iterator[_Record]:
    """One record after another; none leads beyond the end."""
    while at < end:
        begin = at
        stream.seek(at)
        (length,) = _LENGTH.unpack(stream.read(_LENGTH.size))
        at += 2 * _LENGTH.size + length
        if length > _LONGEST_HEADER or at > end:
            raise ValueError(f"a record at byte {begin} of {end} states {length} bytes of fields")
        fields = _fields(stream.read(length))
        (size,) = _LENGTH.unpack(stream.read(_LENGTH.size))
        if at + size > end:
            raise ValueError(f"a record at byte {begin} of {end} states {size} bytes of data")
        yield _Record(begin, fields, at, size)
        at += size


def _fields(content: bytes) -> dict[bytes, bytes]:
    found, at = {}, 0
    while at < len(content):
        (length,) = _LENGTH.unpack_from(content, at)
        at += _LENGTH.size
        if at + length > len(content):
            raise ValueError("a field is longer than its record")
        name, _, value = content[at : at + length].partition(b"=")
        found[name] = value
        at += length
    return found


def _note(stream: BinaryIO, record: _Record, seen: _Seen, spending: Spending) -> None:
    fields, at, length = record.fields, record.at, record.length
    kind = fields.get(b"op", b"\0")[:1]
    if kind == _CHUNK:
        stream.seek(at)
        (size,) = _LENGTH.unpack(fields[b"size"]) if b"size" in fields else (0,)
        places = _places(_opened(stream.read(length), fields.get(b"compression", b""), size, spending), spending)
        seen.chunks[record.begin] = _Chunk(len(seen.chunks), size, places)
    elif kind == _INDEX and seen.chunks:
        stream.seek(at)
        entries = np.frombuffer(stream.read(length - length % _ENTRY.itemsize), _ENTRY)
        spending.take_parts(len(entries))
        chunk = list(seen.chunks.values())[-1]
        if not chunk.places.issuperset(entries["place"].tolist()):
            raise ValueError(f"the index at byte {at} has places where no message is")
        seen.times.append(entries["seconds"].astype(np.int64) * 10**9 + entries["nanoseconds"])
        seen.numbers.append(np.full(len(entries), chunk.number))
    elif kind == _CHUNK_INFO:
        place = int.from_bytes(fields.get(b"chunk_pos", b""), "little")
        if place in seen.listed:
            raise BudgetError(f"{spending.path}: its index lists the chunk at byte {place} more than once.")
        if place not in seen.chunks:
            raise ValueError(f"the index lists a chunk at byte {place}, where none is")
        seen.listed.add(place)
    elif kind == _CONNECTION:
        stream.seek(at)
        seen.definitions.append(_fields(stream.read(length)).get(b"message_definition", b"").decode(errors="replace"))


def _opened(content: bytes, compression: bytes, size: int, spending: Spending) -> bytes:
    """A chunk's data, if they are as long as the chunk states."""
    if compression == b"none":
        return content
    open_ = _DECOMPRESS.get(compression)
    if open_ is None:
        raise ValueError(f"compression {compression[:20]!r} is not supported")
    if size > spending.budget.bag_chunk:
        raise BudgetError(
            f"{spending.path}: a chunk yields {size} bytes, beyond the limit of {spending.budget.bag_chunk} for a bag "
            f"of {spending.budget.size} bytes."
        )
    spending.take_opened(size * (BZ2_BYTES if compression == b"bz2" else 1))
    try:
        data = open_(content, size + 1)
    except (OSError, RuntimeError, EOFError) as error:
        raise ValueError(f"a chunk does not decompress: {error}") from error
    if len(data) != size:
        raise ValueError(f"a chunk has {len(data)} bytes or more after decompression, and states {size}")
    return data


def _places(data: bytes, spending: Spending) -> set[int]:
    """Where messages are in an opened chunk, and the few connections before each."""
    places: set[int] = set()
    at = between = 0
    waiting: list[int] = []
    while at + _LENGTH.size <= len(data):
        (length,) = _LENGTH.unpack_from(data, at)
        fields = at + _LENGTH.size
        if fields + length + _LENGTH.size > len(data) or length > _LONGEST_HEADER:
            raise ValueError("a record in a chunk is longer than the chunk")
        kind = _fields(data[fields : fields + length]).get(b"op", b"")
        waiting.append(at)
        if kind == _MESSAGE:
            places.update(waiting[-_MOST_BETWEEN:])
            waiting.clear()
        (size,) = _LENGTH.unpack_from(data, fields + length)
        at = fields + length + _LENGTH.size + size
        between += 1
        if between % 1000 == 0:
            spending.take_parts(1000)
    spending.take_parts(between % 1000)
    return places


def _check_order(seen: _Seen, spending: Spending) -> None:
    """Hold against the budget how often chunks are opened: messages are read by time, and one chunk is open at once."""
    if not seen.times:
        return
    numbers = np.concatenate(seen.numbers)[np.argsort(np.concatenate(seen.times), kind="stable")]
    sizes = np.array([chunk.size for chunk in seen.chunks.values()], dtype=np.int64)
    changes = np.append(True, np.diff(numbers) != 0)
    spending.check_opened(int(sizes[numbers[changes]].sum()))


_DECOMPRESS: dict[bytes, Callable[[bytes, int], bytes]] = {
    b"bz2": lambda content, most: bz2.BZ2Decompressor().decompress(content, max_length=most),
    b"lz4": lambda content, most: bytes(lz4.frame.LZ4FrameDecompressor().decompress(content, max_length=most)),
}


#: Bytes that are decompressed at once, to count them.
_PIECE = 1 << 20


def check_ros2_bag(bag: Path, spending: Spending) -> None:
    """Refuse a bag's folder or db3 file that asks for more than one of its size may, or has more than plain tables.

    That is a BudgetError; a LogError says that it is in MCAP already, or cannot be read.
    """
    if bag.suffix == ".mcap" or (bag.is_dir() and not any(bag.glob("*.db3*")) and any(bag.glob("*.mcap"))):
        raise LogError(f"{bag} is in MCAP already: no conversion is needed. Give it to gtsam-rwhec init as it is.")
    metadata = bag / "metadata.yaml"
    mode = ""
    if bag.is_dir() and metadata.is_file():
        mode = _compression_mode(metadata, spending.budget.size)
    files = sorted(bag.glob("*.db3*")) if bag.is_dir() else [bag]
    for file in files:
        if mode == "file":
            _count_opened(file, spending)
        else:
            _check_database(file, spending, has_compressed_messages=mode == "message")


def _compression_mode(metadata: Path, size: int) -> str:
    most = BAG_METADATA + int(BAG_METADATA_SHARE * size)
    if metadata.stat().st_size > most:
        raise BudgetError(f"{metadata} has more than {most} bytes, and that of a bag of {size} bytes may have no more.")
    try:
        value: Any = read_yaml(metadata).data
    except FileFormatError as error:
        raise LogError(f"{metadata.parent} cannot be read as a ROS bag: {error}") from error
    information = value.get("rosbag2_bagfile_information") if isinstance(value, dict) else None
    mode = information.get("compression_mode") if isinstance(information, dict) else None
    return mode.lower() if isinstance(mode, str) else ""


def _count_opened(file: Path, spending: Spending) -> None:
    """Decompress a file to nowhere, to see that it does not grow beyond the budget."""
    try:
        with (
            open(file, "rb") as stream,
            zstandard.ZstdDecompressor(max_window_size=1 << 27).stream_reader(
                stream, read_across_frames=True
            ) as opened,
        ):
            while piece := opened.read(_PIECE):
                spending.take_opened(len(piece))
    except (OSError, zstandard.ZstdError) as error:
        raise LogError(f"{file} cannot be read: {error}") from error


def _check_database(file: Path, spending: Spending, *, has_compressed_messages: bool) -> None:
    try:
        with closing(sqlite3.connect(f"{file.resolve().as_uri()}?immutable=1", uri=True)) as database:
            database.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, spending.budget.bag_chunk)
            tables = []
            for kind, name, definition in database.execute("SELECT type, name, sql FROM sqlite_master"):
                spending.take_parts(1)
                text = str(definition or "").upper()
                if kind not in ("table", "index") or "VIRTUAL TABLE" in text:
                    raise BudgetError(f"{file} has a {kind}, {str(name)[:80]!r}: a bag has plain tables and indexes.")
                if kind == "table":
                    tables.append(str(name))
            for name in tables:
                quoted = name.replace('"', '""')
                columns = database.execute(f'PRAGMA table_xinfo("{quoted}")').fetchall()
                if any(column[6] for column in columns):
                    raise BudgetError(f"{file}: the table {name[:80]!r} has computed columns: a bag has none.")
            if "message_definitions" in tables:
                rows = database.execute("SELECT encoded_message_definition FROM message_definitions")
                check_definitions((str(row[0]) for row in rows), file, spending.budget.size)
            if has_compressed_messages and "messages" in tables:
                for (data,) in database.execute("SELECT data FROM messages"):
                    _count_message(data, file, spending)
    except sqlite3.Error as error:
        raise LogError(f"{file} cannot be read as a ROS bag: {error}") from error


def _count_message(data: object, file: Path, spending: Spending) -> None:
    if not isinstance(data, bytes):
        raise LogError(f"{file}: a message is {type(data).__name__} in place of bytes")
    total = 0
    try:
        with zstandard.ZstdDecompressor(max_window_size=1 << 27).stream_reader(data, read_across_frames=True) as opened:
            while piece := opened.read(_PIECE):
                total += len(piece)
                spending.take_opened(len(piece))
                if total > spending.budget.bag_chunk:
                    raise BudgetError(f"{file}: a message yields more than {spending.budget.bag_chunk} bytes.")
    except zstandard.ZstdError as error:
        raise LogError(f"{file}: a message does not decompress: {error}") from error


#: A list of fixed length in a definition: its type and its length.
_FIXED = re.compile(r"^[ \t]*([\w/]+)(?:<=\d+)?\[(\d+)\]", re.MULTILINE)
_NUMBERS = re.compile(r"bool|byte|char|u?int(8|16|32|64)|float(32|64)")


def check_definitions(definitions: Iterable[str], path: Path, size: int) -> None:
    """Refuse definitions that take long to read, or that make long code; `size` is the bag's, in bytes.

    Raises a BudgetError.
    """
    most = BAG_DEFINITIONS + int(BAG_DEFINITIONS_SHARE * size)
    total = 0
    for definition in definitions:
        total += len(definition)
        if total > most:
            raise BudgetError(
                f"{path}: the definitions of its messages have more than {most} bytes, and those of a bag of {size} "
                "bytes may have no more. It is damaged, or made to exhaust who reads it."
            )
        for type_, length in _FIXED.findall(definition):
            if not _NUMBERS.fullmatch(type_) and (len(length) > 9 or int(length) > FIXED_LIST):
                raise BudgetError(
                    f"{path}: a message has a list of {length[:20]} {type_[:80]}, and at most {FIXED_LIST} are read."
                )
