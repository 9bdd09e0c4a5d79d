"""Intrinsics: the first byte says whether the rest is Kalibr's, or of ROS or OpenCV."""

from __future__ import annotations

import random
from collections.abc import Callable, Iterable

import numpy as np
from harness import Harness, scratch
from mutations import words_and_lines

from gtsam_rwhec.vision import camera, intrinsics_files

FOLDER = scratch()
KALIBR = b"""\
cam0:
  cam_overlaps: [1]
  camera_model: pinhole
  distortion_coeffs: [-0.28, 0.07, 0.0002, 1.8e-05]
  distortion_model: radtan
  intrinsics: [458.6, 457.3, 367.2, 248.4]
  resolution: [752, 480]
cam1:
  T_cn_cnm1:
  - [1.0, 0.0, 0.0, -0.11]
  camera_model: pinhole
  distortion_coeffs: [0.01, -0.02, 0.003, -0.0004]
  distortion_model: equidistant
  intrinsics: [300, 301, 320, 240]
  resolution: [640, 480]
"""
ROS = b"""\
image_width: 640
image_height: 480
camera_name: narrow_stereo
camera_matrix:
  rows: 3
  cols: 3
  data: [430.2, 0, 306.7, 0, 430.5, 227.2, 0, 0, 1]
distortion_model: plumb_bob
distortion_coefficients: {rows: 1, cols: 5, data: [-0.34, 0.18, 1e-3, -2.e-4, 0]}
"""
OPENCV = b"""\
%YAML:1.0
---
image_width: 640
image_height: 480
fisheye_model: 0
camera_matrix: !!opencv-matrix
   rows: 3
   cols: 3
   dt: d
   data: [ 430.2, 0., 306.7, 0., 430.5, 227.2, 0., 0., 1. ]
distortion_coefficients: !!opencv-matrix
   rows: 5
   cols: 1
   dt: d
   data: [ -0.34, 0.18, 1e-3, -2.e-4, 0. ]
"""


def read(data: bytes) -> None:
    """The cameras; what is read as a camera can be used as one."""
    path = FOLDER / "camera.yaml"
    path.write_bytes(data[1:])
    if data[:1] == b"K":
        cameras = list(intrinsics_files.read_kalibr_camchain(path).values())
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
    yield b"K" + KALIBR
    yield b"R" + ROS
    yield b"R" + OPENCV
    yield b"R" + ROS.replace(b"plumb_bob", b"rational_polynomial").replace(b"cols: 5", b"cols: 8").replace(
        b"-2.e-4, 0]", b"-2.e-4, 0, 0, 0, 0]"
    )


HARNESS = Harness(read, seeds, mutate)
