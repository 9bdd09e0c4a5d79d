"""What is read whole: files and what a shell hands over, up to a size; and nothing that could be waited for."""

from __future__ import annotations

import os
import re
import socket
import stat
import subprocess
import sys
import threading
from collections.abc import Callable
from pathlib import Path

import pytest
from places import REPOSITORY

import gtsam_rwhec as rw
from gtsam_rwhec.cameras.intrinsics_files import read_calibration_yaml, read_kalibr_camchain
from gtsam_rwhec.errors import FileFormatError
from gtsam_rwhec.files.whole_files import atomic_stream, checked_path, opened, read_whole, write_atomically
from gtsam_rwhec.problem.csv_folder import read_pose_rows


def folder(path: Path) -> Path:
    path.mkdir()
    return path


def pipe(path: Path) -> Path:
    os.mkfifo(path)
    return path


def listening(path: Path) -> Path:
    socket.socket(socket.AF_UNIX).bind(str(path))
    return path


def loop(path: Path) -> Path:
    path.symlink_to(path.name)
    return path


NO_FILES: dict[str, tuple[Callable[[Path], Path], str]] = {
    "missing": (lambda path: path, "No such file"),
    "in a file": (lambda path: Path(__file__) / "x", "Not a directory"),
    "folder": (folder, "it is a folder"),
    "pipe": (pipe, "it is a pipe; give a file, or /dev/stdin"),
    "socket": (listening, "No such device"),
    "endless device": (lambda path: Path("/dev/zero"), "it is a device"),
    "link to itself": (loop, "symbolic links"),
    "long name": (lambda path: path.with_name("x" * 300), "no file can have so long a name"),
    "null character": (lambda path: path.with_name("a\0b"), "is not a path"),
}
READERS: dict[str, Callable[[Path], object]] = {
    "whole": lambda path: read_whole(path, 100, "Words were"),
    "csv": read_pose_rows,
    "kalibr": read_kalibr_camchain,
    "intrinsics": read_calibration_yaml,
    "rig": rw.rig.read_rig,
    "results": rw.read_solution,
    "log": rw.logs.open_log,
}


@pytest.mark.parametrize("kind", NO_FILES)
def test_what_is_no_table_of_poses_is_refused_at_once(tmp_path: Path, kind: str) -> None:
    make, words = NO_FILES[kind]
    if kind == "folder":  # it may hold one pose a file
        words = "x has no files of poses"
    (tmp_path / "images").mkdir()
    (tmp_path / "images" / "a.png").write_bytes(b"x")
    with pytest.raises(FileFormatError, match=words):
        rw.logs.write_image_folder(tmp_path / "images", make(tmp_path / "x"), tmp_path / "out.mcap")
    assert not (tmp_path / "out.mcap").exists()


@pytest.mark.parametrize("kind", ["folder", "pipe", "endless device"])
def test_what_is_no_image_is_refused_at_once(tmp_path: Path, kind: str) -> None:
    make, words = NO_FILES[kind]
    (tmp_path / "images").mkdir()
    image = tmp_path / "images" / "a.png"
    if (made := make(image)) != image:
        image.symlink_to(made)
    (tmp_path / "images" / "b.png").touch()
    (tmp_path / "poses.txt").write_text("a 1 2 3 0 0 0 1\nb 1 2 4 0 0 0 1")
    with pytest.raises(FileFormatError, match=words):
        rw.logs.write_image_folder(tmp_path / "images", tmp_path / "poses.txt", tmp_path / "out.mcap")
    assert not (tmp_path / "out.mcap").exists()


@pytest.mark.parametrize("kind", NO_FILES)
@pytest.mark.parametrize("reader", READERS)
def test_what_is_no_file_is_refused_at_once(tmp_path: Path, reader: str, kind: str) -> None:
    make, words = NO_FILES[kind]
    if (reader, kind) == ("log", "folder"):  # of a bag
        words = "no MCAP files there"
    with pytest.raises(FileFormatError, match=words):
        READERS[reader](make(tmp_path / "x"))


def test_a_file_is_read_up_to_its_limit(tmp_path: Path) -> None:
    (tmp_path / "a").write_bytes(b"x" * 100)
    (tmp_path / "link").symlink_to("a")
    assert read_whole(tmp_path / "link", 100, "Words were") == b"x" * 100
    with pytest.raises(FileFormatError, match=r"a is larger than 99 bytes; is it the right file\? Words were expected"):
        read_whole(tmp_path / "a", 99, "Words were")


@pytest.mark.parametrize("name", ["/dev/stdin", "/dev/fd/0"])
def test_what_a_shell_hands_over_is_read(name: str) -> None:
    code = f"from gtsam_rwhec.files.whole_files import read_whole; print(read_whole('{name}', 9, 'x'))"
    process = subprocess.Popen([sys.executable, "-c", code], stdin=subprocess.PIPE, stdout=subprocess.PIPE)
    said, _ = process.communicate(b"one two")  # written late: the reader waits for it
    assert said == b"b'one two'\n"


def test_an_endless_stream_is_read_up_to_the_limit() -> None:
    with open("/dev/zero", "rb") as zeros, pytest.raises(FileFormatError, match="larger than 1000 bytes"):
        read_whole(f"/dev/fd/{zeros.fileno()}", 1000, "Words were")


@pytest.mark.skipif(os.geteuid() == 0, reason="root may read every file")
def test_a_file_without_the_right_to_read_it(tmp_path: Path) -> None:
    (tmp_path / "a").write_bytes(b"x")
    (tmp_path / "a").chmod(0)
    with pytest.raises(FileFormatError, match="Permission denied"):
        opened(tmp_path / "a")


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
        r"""open\([^)\n]*["'][wax]b?\+?["']|\.write_(text|bytes)\(|imwrite\(|\.to_csv\(|np\.save\w*\((?!stream)|json\.dump\("""
    )
    found = {
        str(path.relative_to(REPOSITORY))
        for package in ("gtsam_rwhec", "factors")
        for path in (REPOSITORY / package).rglob("*.py")
        if writing.search(path.read_text(encoding="utf-8"))
    }
    assert found == {"gtsam_rwhec/files/whole_files.py"}


def test_a_path() -> None:
    assert checked_path("a/b") == checked_path(Path("a/b")) == Path("a/b")


@pytest.mark.parametrize("path", [None, 3, b"a", True, ["a"], "a\0b", Path("a\0b"), "\ud800", object()])
def test_no_path(path: object) -> None:
    for read in (checked_path, rw.read_solution, rw.read_csv):
        with pytest.raises(FileFormatError, match=r"is not a path; give the name of a file or folder"):
            read(path)


@pytest.mark.parametrize("path", ["x" * 256, "é" * 128, "a/" * 2048 + "b"])
def test_a_path_that_is_too_long(path: str) -> None:
    for read in (checked_path, rw.read_solution, rw.read_csv):
        with pytest.raises(FileFormatError, match="is not a path; no file can have so long a name") as caught:
            read(path)
        assert len(str(caught.value)) < 300
