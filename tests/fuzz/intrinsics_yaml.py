"""Intrinsics: the first byte says whether the rest is Kalibr's, of ROS or OpenCV, or of whichever it is."""

from __future__ import annotations

import random
from collections.abc import Callable, Iterable

import numpy as np
from harness import Harness, scratch
from intrinsics_samples import CAMCHAIN, OPENCV, ROS
from mutations import words_and_lines

from gtsam_rwhec.cameras import camera, intrinsics_files

FOLDER = scratch()


def read(data: bytes) -> None:
    """The cameras; what is read as a camera can be used as one."""
    path = FOLDER / "camera.yaml"
    path.write_bytes(data[1:])
    if data[:1] == b"K":
        cameras = list(intrinsics_files.read_kalibr_camchain(path).values())
    elif data[:1] == b"C":
        cameras = list(intrinsics_files.read_cameras(path, (640, 480)).values())
    else:
        cameras = [intrinsics_files.read_calibration_yaml(path)]
    for each in cameras:
        assert isinstance(each, camera.Camera)
        each.project(np.array([[0.1, 0.05, 1.0], [0.0, 0.0, 1.0]]))


def mutate(data: bytes, chance: random.Random, plain: Callable[[bytes], bytes]) -> bytes:
    """Change words and lines, and leave the first byte."""
    return data[:1] + words_and_lines(data[1:], chance, plain)


def seeds() -> Iterable[bytes]:
    """One file of each program."""
    eight_coefficients = ROS.replace("plumb_bob", "rational_polynomial").replace("cols: 5", "cols: 8")
    yield b"K" + CAMCHAIN.encode()
    yield b"R" + ROS.encode()
    yield b"R" + OPENCV.encode()
    yield b"C# Camera list\n1 PINHOLE 640 480 500 501 320 240\n2 OPENCV 640 480 500 500 320 240 0.1 0 0 1e-3\n"
    yield (
        b'C<?xml version="1.0"?>\n<opencv_storage><M1 type_id="opencv-matrix"><rows>3</rows><cols>3</cols><dt>d</dt>'
        b'<data>500. 0. 320. 0. 500. 240. 0. 0. 1.</data></M1>\n<D1 type_id="opencv-matrix"><rows>1</rows>'
        b"<cols>5</cols><data>0. 0. 0. 0. 0.</data></D1></opencv_storage>\n"
    )
    yield b"R" + eight_coefficients.replace("-2.e-4, 0]", "-2.e-4, 0, 0, 0, 0]").encode()

    yield b"C%YAML:1.0\n---\ncameras:\n" + b"".join(
        f"   {name}:\n".encode() + b"".join(b"      " + line + b"\n" for line in OPENCV.encode().splitlines()[2:])
        for name in ("left", "right")
    )


HARNESS = Harness(read, seeds, mutate)
