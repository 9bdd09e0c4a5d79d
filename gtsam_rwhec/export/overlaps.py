"""Which cameras have overlapping fields of view, from their poses and intrinsics."""

from __future__ import annotations

import numpy as np
from rwhec_factors.se3 import inverse

from gtsam_rwhec.cameras.camera import Camera
from gtsam_rwhec.geometry.poses import Array

#: Metres. The points that are tried have depths between these two.
NEAR_M, FAR_M = 0.2, 20.0
#: The points that are tried in each field of view form a grid of pixels across, pixels down, and depths.
COLUMNS, ROWS, DEPTHS = 17, 13, 25


def overlaps(cameras: list[Camera], T_rig_camera: list[Array]) -> list[list[int]]:
    """For each camera, the other cameras whose field of view overlaps its own, between `NEAR_M` and `FAR_M`.

    `T_rig_camera` has the cameras' poses (4, 4) in any common frame, metres. Cameras stand as
    their indices, ascending; the relation is symmetric.
    """
    points = [_view(camera) for camera in cameras]
    T_camera_rig = inverse(np.array(T_rig_camera))
    sees = np.zeros((len(cameras), len(cameras)), dtype=bool)
    for i, T_rig_i in enumerate(T_rig_camera):
        for j, T_j_rig in enumerate(T_camera_rig):
            T_j_i = T_j_rig @ T_rig_i
            in_j = points[i] @ T_j_i[:3, :3].T + T_j_i[:3, 3]
            sees[i, j] = i != j and bool(cameras[j].inside(cameras[j].project(in_j)).any())
    return [np.flatnonzero(row).tolist() for row in sees | sees.T]


def _view(camera: Camera) -> Array:
    """Points (N, 3) that a camera sees, in the camera's frame, metres."""
    u, v = np.meshgrid(np.linspace(0.0, camera.width - 1.0, COLUMNS), np.linspace(0.0, camera.height - 1.0, ROWS))
    x = camera.undistort(np.stack([u, v], axis=-1).reshape(-1, 2))
    rays = np.column_stack([x, np.ones(len(x))])[np.isfinite(x).all(axis=1)]
    points: Array = (np.geomspace(NEAR_M, FAR_M, DEPTHS)[:, None, None] * rays).reshape(-1, 3)
    return points
