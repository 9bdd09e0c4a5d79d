"""Clouds of a robot's 3D camera, nine views of each thing: ``clouds`` of the shared data, with their poses."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from rwhec_factors.se3 import inverse, pose
from scipy.spatial.transform import Rotation

import gtsam_rwhec as rw


def _points(file: Path) -> np.ndarray:
    """Points (n, 3) of a binary PCD file of x, y, z and four bytes of padding."""
    raw = file.read_bytes()
    start = raw.index(b"DATA binary\n") + len(b"DATA binary\n")
    return np.frombuffer(raw[start:], dtype="<f4").reshape(-1, 4)[:, :3].astype(np.float64)


def views_of(folder: Path, thing: str) -> tuple[list[rw.clouds.Cloud], np.ndarray]:
    """The clouds of a thing, and A = T_flange_base (N, 4, 4)."""
    if not (folder / thing).is_dir():
        pytest.skip(f"{folder / thing} is not there: set GTSAM_RWHEC_DATA to the folder that has clouds/{thing}")
    rows = np.genfromtxt(folder / thing / "RobotPoses.dat", delimiter=",")[:, :6]
    T_base_flange = pose(Rotation.from_euler("ZYX", rows[:, [2, 1, 0]]).as_matrix(), rows[:, 3:] / 1000.0)
    files = [folder / thing / f"view{k + 1}d.pcd" for k in range(len(rows))]
    return [rw.clouds.Cloud.of(_points(file), source=file.stem) for file in files], inverse(T_base_flange)
