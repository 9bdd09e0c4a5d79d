"""What is read whole: files and what a shell hands over, up to a size; and nothing that could be waited for."""

from __future__ import annotations

import os
import socket
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

import gtsam_rwhec as rw
from gtsam_rwhec.cameras.intrinsics_files import read_calibration_yaml, read_kalibr_camchain
from gtsam_rwhec.errors import FileFormatError
from gtsam_rwhec.files.whole_files import opened, read_whole
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
}


@pytest.mark.parametrize("kind", [kind for kind in NO_FILES if kind != "folder"])  # a folder of a bag is a log
def test_what_is_no_log_is_refused_at_once(tmp_path: Path, kind: str) -> None:
    make, words = NO_FILES[kind]
    with pytest.raises(FileFormatError, match=words):
        rw.logs.open_log(make(tmp_path / "x"))


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
    (tmp_path / "poses.txt").write_text("a 1 2 3 0 0 0 1")
    with pytest.raises(FileFormatError, match=words):
        rw.logs.write_image_folder(tmp_path / "images", tmp_path / "poses.txt", tmp_path / "out.mcap")
    assert not (tmp_path / "out.mcap").exists()


@pytest.mark.parametrize("kind", NO_FILES)
@pytest.mark.parametrize("reader", READERS)
def test_what_is_no_file_is_refused_at_once(tmp_path: Path, reader: str, kind: str) -> None:
    make, words = NO_FILES[kind]
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
