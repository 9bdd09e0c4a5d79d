"""The rows of several runs, from their outputs or from files of rows: what the watch reads."""

from __future__ import annotations

from collections.abc import Iterable

from gtsam_rwhec.fleet.parquet import read_parquet
from gtsam_rwhec.fleet.rows import RobotRow, read_rows
from gtsam_rwhec.fleet.stores import exists, read_bytes
from gtsam_rwhec.fleet.without_secrets import shown

#: The names of the files of rows in an output: JSON, and the same as Parquet.
ROWS_FILES = ("fleet.json", "fleet.parquet")


def read_history(urls: Iterable[str]) -> tuple[RobotRow, ...]:
    """The rows of several runs, in the order given.

    Parameters
    ----------
    urls : str
        Folders that ``gtsam-rwhec fleet run`` wrote, or files of rows (``fleet.json``, ``*.parquet``): paths or URLs.

    Raises
    ------
    StoreError, StoreInterruptedError
        There is no such file, or it is refused.
    FileFormatError, ResultVersionError
        It is none of rows, or of another version.
    """
    return tuple(row for url in urls for row in _read(url))


def _read(url: str) -> tuple[RobotRow, ...]:
    if not url.endswith((".json", ".parquet")):
        inside = [f"{url.rstrip('/')}/{name}" for name in ROWS_FILES]
        url = next((each for each in inside if exists(each)), inside[0])
    content = read_bytes(url)
    return read_parquet(content, shown(url)) if url.endswith(".parquet") else read_rows(content, shown(url))
