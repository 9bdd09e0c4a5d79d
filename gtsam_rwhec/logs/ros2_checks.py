"""ROS 2 db3 bags held against their budget before the `rosbags` library reads them.

A database can hold views, virtual tables and computed columns, which make any number of rows of any size out of
nothing. A bag has plain tables and indexes.
"""

from __future__ import annotations

import sqlite3
from contextlib import closing
from pathlib import Path
from typing import Any

import zstandard

from gtsam_rwhec.errors import BudgetError, FileFormatError, LogError
from gtsam_rwhec.files.budgets import BAG_METADATA, BAG_METADATA_SHARE, Spending
from gtsam_rwhec.files.yaml_lines import read_yaml
from gtsam_rwhec.logs.bag_definitions import check_definitions

#: Bytes that are decompressed at once, to count them.
_PIECE = 1 << 20


def check_ros2_bag(bag: Path, spending: Spending) -> None:
    """Refuse a bag that asks for more memory or work than one of its size may.

    Parameters
    ----------
    bag
        The folder of a ROS 2 bag, or a db3 file.
    spending : Spending
        Of all the files of the bag.

    Raises
    ------
    BudgetError
        It does; or its database has more than plain tables.
    LogError
        It is in MCAP already, or it cannot be read.
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
