"""COLMAP's cameras.txt: every supported model, in the convention of pixels of this library; others are named."""

from __future__ import annotations

from pathlib import Path

import pytest

from gtsam_rwhec.cameras.intrinsics_files import is_colmap, read_colmap_cameras
from gtsam_rwhec.errors import FileFormatError

HEAD = "# Camera list with one line of data per camera:\n#   CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]\n"
LINES = {
    "SIMPLE_PINHOLE 640 480 500 320 240": ("pinhole", 500.0, []),
    "PINHOLE 640 480 500 501 320 240": ("pinhole", 501.0, []),
    "SIMPLE_RADIAL 640 480 500 320 240 0.1": ("radtan", 500.0, [0.1, 0.0, 0.0, 0.0]),
    "RADIAL 640 480 500 320 240 0.1 0.02": ("radtan", 500.0, [0.1, 0.02, 0.0, 0.0]),
    "OPENCV 640 480 500 501 320 240 0.1 0.02 3e-3 4e-3": ("radtan", 501.0, [0.1, 0.02, 3e-3, 4e-3]),
    "FULL_OPENCV 640 480 500 501 320 240 .1 .02 .003 .004 .05 .06 .07 .08": (
        "radtan", 501.0, [0.1, 0.02, 0.003, 0.004, 0.05, 0.06, 0.07, 0.08],
    ),
    "OPENCV_FISHEYE 640 480 500 501 320 240 0.1 0.02 0.3 0.4": ("equidistant", 501.0, [0.1, 0.02, 0.3, 0.4]),
}  # fmt: skip


@pytest.mark.parametrize("line", sorted(LINES))
def test_each_model(tmp_path: Path, line: str) -> None:
    text = f"{HEAD}7 {line}\n"
    (tmp_path / "cameras.txt").write_text(text)
    assert is_colmap(text)
    (camera,) = read_colmap_cameras(tmp_path / "cameras.txt").values()
    model, fy, D = LINES[line]
    assert (camera.width, camera.height, camera.model) == (640, 480, model)
    # The middle of COLMAP's first pixel is at 0.5, and here at 0.
    assert camera.K.tolist() == [[500.0, 0.0, 319.5], [0.0, fy, 239.5], [0.0, 0.0, 1.0]]
    assert camera.D.tolist() == D


def test_cameras_have_colmaps_numbers(tmp_path: Path) -> None:
    (tmp_path / "cameras.txt").write_text(f"{HEAD}2 PINHOLE 64 48 50 50 32 24\n1 PINHOLE 64 48 60 60 32 24\n")
    assert [c.K[0, 0] for c in read_colmap_cameras(tmp_path / "cameras.txt").values()] == [50.0, 60.0]
    assert list(read_colmap_cameras(tmp_path / "cameras.txt")) == ["2", "1"]


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ("1 FOV 64 48 50 50 32 24 0.9", "line 3: the model 'FOV' is not supported; supported are SIMPLE_PINHOLE, "),
        ("1 OPENCV 64 48 50 50 32 24", "line 3: OPENCV has the parameters fx fy cx cy k1 k2 p1 p2, and here are 4"),
        ("1 PINHOLE 64 48 50 50 32 x", "line 3: a parameter is no number"),
        ("1 PINHOLE 64 48 50 50 32 inf", "line 3: PINHOLE has the parameters"),
        ("1 PINHOLE wide 48 50 50 32 24", "line 3: '1 PINHOLE wide 48 50 50 32 24' is no camera of COLMAP"),
        ("1 PINHOLE 64 48 50 50 32 24\n1 PINHOLE 64 48 50 50 32 24", "line 4: camera 1 is there twice"),
        ("", "has no cameras"),
    ],
)  # fmt: skip
def test_what_is_no_camera(tmp_path: Path, line: str, words: str) -> None:
    (tmp_path / "cameras.txt").write_text(f"{HEAD}{line}\n")
    with pytest.raises(FileFormatError) as caught:
        read_colmap_cameras(tmp_path / "cameras.txt")
    assert words in str(caught.value)
