"""Poses: tables beside a folder of images, trees, and samples of hand-eye tools.

The first byte names the kind: of a table, the order of the columns and the images' names.
"""

from __future__ import annotations

import random
from collections.abc import Callable, Iterable
from typing import get_args

import numpy as np
from harness import Harness, scratch
from mutations import words_and_lines

from gtsam_rwhec.logs import image_folder
from gtsam_rwhec.logs.hand_eye_samples import read_hand_eye_samples
from gtsam_rwhec.logs.image_folder import read_poses
from gtsam_rwhec.logs.pose_tables import PoseStatement

FOLDER = scratch()
#: Bits of the first byte.
TREE, SAMPLES = 16, 32
COLUMNS = get_args(image_folder.Columns)
BY_NAME, BY_STAMP = FOLDER / "named", FOLDER / "stamped"
IMAGES = [
    BY_NAME / "im_1.png",
    BY_NAME / "im_2.jpg",
    BY_STAMP / "1700000000300000000.png",
    BY_STAMP / "1700000001.5.png",
]
for _image in IMAGES:
    _image.parent.mkdir(exist_ok=True)
    _image.write_bytes(b"x")


def read(data: bytes) -> None:
    """A log of two images and of the table's poses."""
    kind = data[0] if data else 0
    if kind & (TREE | SAMPLES):
        tree = FOLDER / "poses.yaml"
        tree.write_bytes(data[1:])
        if kind & SAMPLES:
            found = read_hand_eye_samples(tree)
            assert np.isfinite(found.A(True)).all()
            assert len(found.B) == len(found.robot)
        else:
            assert np.isfinite(read_poses(tree, PoseStatement(euler="ZYX", angles="degrees")).T).all()
        return
    table = FOLDER / "poses.txt"
    table.write_bytes(data[1:])
    images = BY_STAMP if kind & 8 else BY_NAME
    image_folder.write_image_folder(images, table, FOLDER / "out.mcap", columns=COLUMNS[kind % len(COLUMNS)])


def mutate(data: bytes, chance: random.Random, plain: Callable[[bytes], bytes]) -> bytes:
    """Change words and lines, and leave the first byte."""
    return data[:1] + words_and_lines(data[1:], chance, plain)


def seeds() -> Iterable[bytes]:
    """Poses by name and by stamp, with commas and with blanks."""
    yield b"\0" + b"image,tx,ty,tz,qx,qy,qz,qw\n# first\nim_1.png,1,2,3,0,0,0.6,0.8\nim_2, 4,2,3,0,0,0,1\n"
    yield b"\x09" + b"1700000000.25 1 2 3 0.8 0 0 0.6\n1700000001000000001 1 2 3 1 0 0 0\n"
    yield b"\x10" + b"---\npose: {position: {x: 1, y: 2, z: 3}, orientation: {x: 0, y: 0, z: 0, w: 1}}\n---\na: [1]\n"
    yield b"\x10" + b"R_gripper2base_0: [1, 0, 0, 0, 1, 0, 0, 0, 1]\nt_gripper2base_0: [1, 2, 3]\nrvec: [[0, 0, 1]]\n"
    yield b"\x20" + b"- effector_wrt_world: [1,0,0,1,0,1,0,2,0,0,1,3,0,0,0,1]\n  object_wrt_sensor: [1,2,3,0,0,0,1]\n"
    yield (
        b"\x20"
        + b"samples:\n- robot: {translation: {x: 1, y: 2, z: 3}, rotation: {x: 0, y: 0, z: 0, w: 1}}\n  optical: {}\n"
    )
    yield (
        b"\x20<opencv_storage><R_gripper2base_0>1 0 0 0 1 0 0 0 1</R_gripper2base_0><t_gripper2base_0>1 2 3"
        b"</t_gripper2base_0><rvec_target2cam_0>1 0 0</rvec_target2cam_0><tvec_target2cam_0>1 2 3</tvec_target2cam_0>"
        b"</opencv_storage>"
    )
    yield b"\x02" + b"im_1 1 0 0 0 1e-3 -2 .5\n"


HARNESS = Harness(read, seeds, mutate)
