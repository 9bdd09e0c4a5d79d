"""A path is text or a path; anything else is refused in words."""

from __future__ import annotations

from pathlib import Path

import pytest

import gtsam_rwhec as rw
from gtsam_rwhec.errors import FileFormatError
from gtsam_rwhec.files.whole_files import checked_path


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
