"""Folders of images with poses, by name and by stamp, and what is wrong with some."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from strategies import damaged, tables

from gtsam_rwhec.errors import LogError
from gtsam_rwhec.logs import ImageRecord, PoseRecord, open_log
from gtsam_rwhec.logs.image_folder import as_ns, write_image_folder

POSE = "1 2 3 0 0 0.6 0.8"


def folder(path: Path, names: list[str]) -> Path:
    path.mkdir(exist_ok=True)
    for i, name in enumerate(names):
        (path / name).write_bytes(bytes([i]))
    return path


def written(tmp_path: Path, names: list[str], text: str, **options: Any) -> list[Any]:
    poses = tmp_path / "poses.txt"
    poses.write_text(text)
    write_image_folder(folder(tmp_path / "images", names), poses, tmp_path / "out.mcap", **options)
    with open_log(tmp_path / "out.mcap") as log:
        return list(log.records())


def test_by_name(tmp_path: Path) -> None:
    names = ["im_10.png", "im_2.jpg", "notes.txt"]
    text = "image,tx,ty,tz,qw,qx,qy,qz\n# first\nim_10.png,1,2,3,0.8,0,0,0.6\nim_2, 4,2,3,1,0,0,0\n"
    records = written(tmp_path, names, text, columns="tx ty tz qw qx qy qz")
    poses = [r for r in records if isinstance(r, PoseRecord)]
    images = [r for r in records if isinstance(r, ImageRecord)]
    assert [(r.stamp_ns, r.T[0, 3], r.parent, r.child) for r in poses] == [
        (10**9, 4, "base", "hand"), (2 * 10**9, 1, "base", "hand"),
    ]  # fmt: skip
    assert poses[1].T[0, 0] == pytest.approx(0.28)
    assert [(r.stamp_ns, r.data, r.encoding, r.frame) for r in images] == [
        (10**9, b"\x01", "jpeg", "camera"), (2 * 10**9, b"\x00", "png", "camera"),
    ]  # fmt: skip


def test_by_stamp(tmp_path: Path) -> None:
    text = f"1.700000000250000000e+09 {POSE}\n1700000001.000000001 {POSE}\n"  # as numpy.savetxt writes it, too
    records = written(tmp_path, ["1700000000300000000.png"], text)
    assert [r.stamp_ns for r in records] == [1700000000250000000, 1700000000300000000, 1700000001000000001]
    assert as_ns("1.000000000000000056e-01") == 100_000_000  # stamps from the start of a log


@pytest.mark.parametrize(
    ("names", "text", "words"),
    [
        (["a.txt"], f"a {POSE}", "no images"),
        (["a.png"], "", "no poses"),
        (["a.png", "c.png"], f"b {POSE}\nd {POSE}", "no pose has the name of an image"),
        (["a.png", "b.png"], f"1700000000.5 {POSE}", "2 images and 1 poses"),
        (["a.png", "b.png"], f"a {POSE}\na 9 2 3 0 0 0.6 0.8", "image a has two poses"),
        (["a.png"], "\n" * 500_001, "has 500001 lines; at most 500000 are read"),
        (["a.png"], f"a {POSE}" + " 1" * 5000, "line 1: longer than 10000 characters"),
        (["a.png"], f"a {POSE}\nb 1 2 3", "line 2: 4 fields"),
        (["a.png"], "x y\nx y\n", "line 2: 2 fields"),
        (["a.png"], "# comment\na 1 2 3 4 5 6 7", r"line 2: quaternion .* norm"),
        (["a.png"], "a nan 2 3 0 0 0 1", "line 1: .* not finite"),
    ],
)
def test_what_does_not_fit(tmp_path: Path, names: list[str], text: str, words: str) -> None:
    with pytest.raises(LogError, match=words):
        written(tmp_path, names, text)
    assert not (tmp_path / "out.mcap").exists()


@settings(max_examples=100, deadline=None)
@given(
    content=(tables(8, f"a {POSE}", " ").map(lambda text: text.encode(errors="surrogatepass")))
    | damaged([b"a 1 2 3 0 0 0.6 0.8\n"])
)
def test_any_table_gives_poses_or_an_error_of_ours(tmp_path_factory: pytest.TempPathFactory, content: bytes) -> None:
    here = tmp_path_factory.getbasetemp() / "any"
    images = folder(here, []) and folder(here / "images", ["a.png"])
    (here / "any.txt").write_bytes(content)
    try:
        write_image_folder(images, here / "any.txt", here / "out.mcap")
    except LogError as error:
        assert "any.txt" in str(error)  # noqa: PT017
        assert len(str(error)) < 2000  # noqa: PT017
