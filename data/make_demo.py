"""Make ``data/demo``: what three cameras on a hand-held rig measure of four tags in a room.

Run ``python data/make_demo.py`` to write the files again; the seed is fixed, so they come out the same. The noise is
that of ordinary tag detections: 5 mm along each axis, 0.5 degrees about each axis.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import gtsam
import numpy as np
from numpy.typing import NDArray

SEED = 20240817
NUMBER_OF_RIG_POSES = 48
SIGMA_M = 0.005
SIGMA_RAD = math.radians(0.5)
HALF_FIELD_OF_VIEW_RAD = math.radians(35.0)
STEEPEST_VIEW_RAD = math.radians(65.0)
"""A tag seen more obliquely than this is not detected."""

#: z of a camera points forward, x to the right, y down; the rig's x points forward, z up.
CAMERA_AXES = gtsam.Rot3(np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]))


def true_sensors() -> dict[str, gtsam.Pose3]:
    """Y = T_rig_cam: one camera forward, one to the left, one to the right and upward."""
    return {
        "cam_0": gtsam.Pose3(CAMERA_AXES, np.array([0.10, 0.00, 0.05])),
        "cam_1": gtsam.Pose3(gtsam.Rot3.Ypr(math.radians(50.0), 0.0, 0.0) * CAMERA_AXES, np.array([0.06, 0.12, 0.05])),
        "cam_2": gtsam.Pose3(
            gtsam.Rot3.Ypr(math.radians(-50.0), math.radians(-15.0), 0.0) * CAMERA_AXES, np.array([0.06, -0.12, 0.07])
        ),
    }


def true_targets() -> dict[str, gtsam.Pose3]:
    """X = T_room_tag: four tags on two walls, none of them quite straight; z of a tag points into the room."""
    into_the_room = gtsam.Rot3(np.array([[0.0, 0.0, -1.0], [1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]))
    left_wall = gtsam.Rot3.Ypr(math.radians(90.0), 0.0, 0.0) * into_the_room
    return {
        "tag_0": gtsam.Pose3(into_the_room * gtsam.Rot3.RzRyRx(0.02, 0.05, 0.10), np.array([2.5, 0.2, 1.3])),
        "tag_1": gtsam.Pose3(into_the_room * gtsam.Rot3.RzRyRx(-0.04, 0.02, 1.50), np.array([2.5, -1.1, 1.7])),
        "tag_2": gtsam.Pose3(left_wall * gtsam.Rot3.RzRyRx(0.03, -0.06, -0.20), np.array([0.9, 2.2, 1.1])),
        "tag_3": gtsam.Pose3(left_wall * gtsam.Rot3.RzRyRx(0.01, 0.04, 0.70), np.array([-0.6, 2.2, 1.5])),
    }


def measure() -> dict[tuple[str, str], tuple[NDArray[np.float64], NDArray[np.float64]]]:
    """(A, B) by (target, sensor): rows qw, qx, qy, qz, tx, ty, tz of T_rig_room and of the noisy T_cam_tag."""
    rng = np.random.default_rng(SEED)
    rows: dict[tuple[str, str], tuple[list[NDArray[np.float64]], list[NDArray[np.float64]]]] = {}
    for _ in range(NUMBER_OF_RIG_POSES):
        heading = gtsam.Rot3.Ypr(rng.uniform(-1.0, 1.8), rng.uniform(-0.4, 0.4), rng.uniform(-0.6, 0.6))
        T_rig_room = gtsam.Pose3(heading, rng.uniform([-0.6, -0.7, 0.9], [0.6, 0.7, 1.7])).inverse()
        for target, T_room_tag in true_targets().items():
            for sensor, T_rig_cam in true_sensors().items():
                T_cam_tag = T_rig_cam.inverse() * T_rig_room * T_room_tag
                # Drawn whether the tag is seen or not, so that moving one tag leaves the others' noise as it was.
                noise = np.concatenate([rng.normal(0.0, SIGMA_RAD, 3), rng.normal(0.0, SIGMA_M, 3)])
                if not _is_seen(T_cam_tag):
                    continue
                measured = gtsam.Pose3(
                    T_cam_tag.rotation() * gtsam.Rot3.Expmap(noise[:3]), T_cam_tag.translation() + noise[3:]
                )
                rows_a, rows_b = rows.setdefault((target, sensor), ([], []))
                rows_a.append(_row(T_rig_room))
                rows_b.append(_row(measured))
    return {pair: (np.array(rows_a), np.array(rows_b)) for pair, (rows_a, rows_b) in rows.items()}


def _is_seen(T_cam_tag: gtsam.Pose3) -> bool:
    line_of_sight = T_cam_tag.translation() / np.linalg.norm(T_cam_tag.translation())
    tag_normal = T_cam_tag.rotation().matrix()[:, 2]
    in_view = line_of_sight[2] > math.cos(HALF_FIELD_OF_VIEW_RAD)
    return bool(in_view and -line_of_sight @ tag_normal > math.cos(STEEPEST_VIEW_RAD))


def _row(pose: gtsam.Pose3) -> NDArray[np.float64]:
    q: Any = pose.rotation().toQuaternion()  # Eigen's quaternion, of which gtsam's stubs say nothing
    return np.array([q.w(), q.x(), q.y(), q.z(), *pose.translation()])


def write(folder: Path) -> None:
    """Write every pair's two files, with nine decimals: a nanometre."""
    folder.mkdir(parents=True, exist_ok=True)
    for (target, sensor), (rows_a, rows_b) in measure().items():
        np.savetxt(folder / f"{target}_{sensor}_A.csv", rows_a, fmt="%.9f", delimiter=",")
        np.savetxt(folder / f"{target}_{sensor}_B.csv", rows_b, fmt="%.9f", delimiter=",")


if __name__ == "__main__":
    write(Path(__file__).parent / "demo")
