"""Files are there whole or not at all."""

from __future__ import annotations

import os
import re
import stat
import threading
from pathlib import Path

import pytest
from places import REPOSITORY

from gtsam_rwhec.errors import FileFormatError
from gtsam_rwhec.files.whole_files import atomic_stream, write_atomically


def test_writes_and_replaces_with_ordinary_permissions(tmp_path: Path) -> None:
    path = tmp_path / "result.json"
    write_atomically(path, b"old")
    write_atomically(path, b"new")
    assert path.read_bytes() == b"new"
    assert list(tmp_path.iterdir()) == [path]
    (tmp_path / "ordinary").touch()
    assert stat.S_IMODE(path.stat().st_mode) == stat.S_IMODE((tmp_path / "ordinary").stat().st_mode)


def test_a_folder_in_the_way_leaves_nothing_behind(tmp_path: Path) -> None:
    (tmp_path / "result.json").mkdir()
    with pytest.raises(FileFormatError, match="directory"):
        write_atomically(tmp_path / "result.json", b"new")
    assert [path.name for path in tmp_path.iterdir()] == ["result.json"]


def test_a_missing_folder_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(FileFormatError, match=r"result.json cannot be written: No such file"):
        write_atomically(tmp_path / "nowhere" / "result.json", b"new")


def test_a_link_is_followed(tmp_path: Path) -> None:
    (tmp_path / "real.json").touch()
    (tmp_path / "link.json").symlink_to("real.json")
    write_atomically(tmp_path / "link.json", b"new")
    assert (tmp_path / "link.json").is_symlink()
    assert (tmp_path / "real.json").read_bytes() == b"new"


def test_a_pipe_is_written_to(tmp_path: Path) -> None:
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    received: list[bytes] = []
    reader = threading.Thread(target=lambda: received.append(pipe.read_bytes()))
    reader.start()
    write_atomically(pipe, b"new")
    reader.join(timeout=10)
    assert received == [b"new"]


def test_an_error_in_the_block_leaves_what_was_there(tmp_path: Path) -> None:
    (tmp_path / "log.mcap").write_bytes(b"old")
    with pytest.raises(TypeError), atomic_stream(tmp_path / "log.mcap") as stream:
        stream.write("new")  # type: ignore[arg-type]
    assert [(path.name, path.read_bytes()) for path in tmp_path.iterdir()] == [("log.mcap", b"old")]


def test_nothing_else_in_the_package_writes_files() -> None:
    """What opens a file to write, or hands a path to a library that does, goes through the functions above."""
    writing = re.compile(
        r"""open\([^)\n]*["'][wax]b?\+?["']|\.write_(text|bytes)\(|imwrite\(|\.to_csv\(|np\.save|json\.dump\("""
    )
    found = {
        str(path.relative_to(REPOSITORY))
        for package in ("gtsam_rwhec", "factors")
        for path in (REPOSITORY / package).rglob("*.py")
        if writing.search(path.read_text(encoding="utf-8"))
    }
    assert found == {"gtsam_rwhec/files/whole_files.py"}
