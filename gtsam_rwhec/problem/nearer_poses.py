"""The choice between a flat board's two poses in an image, again: by an answer that all measurements have together."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import gtsam
import numpy as np

from gtsam_rwhec.cameras.camera import Camera
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.problem.corner_poses import candidates_of
from gtsam_rwhec.problem.measurements import Measurements
from gtsam_rwhec.problem.pairs import Pair
from gtsam_rwhec.problem.problem import Problem

#: Entries of two rotations that are one pose of an image.
SAME_POSE = 1e-3


def nearer_poses(
    problem: Problem,
    X: Mapping[str, gtsam.Pose3],
    Y: Mapping[str, gtsam.Pose3],
    cameras: Mapping[str, Camera] | None = None,
) -> tuple[Problem, int]:
    """The problem in which each image has the pose that is nearer to an answer's, and how many images changed.

    Parameters
    ----------
    problem : Problem
        Measurements that were added as poses stay, and so do those of frames that the answer lacks.
    X, Y : dict of str to gtsam.Pose3
        The answer's T_targetcarrier_target and T_sensorcarrier_sensor.
    cameras : dict of str to Camera, optional
        Other intrinsics by sensor, by which the poses of all their images are computed; the problem's own stay as
        they were stated.
    """
    if not problem.boards or not problem.has_measurements:
        return problem, 0
    every: dict[Pair, Measurements] = {}
    number = 0
    for pair in problem.pairs:
        raw = every[pair] = problem.measurements(*pair)
        if raw.pixels is None or raw.covariances is None or pair.target not in X or pair.sensor not in Y:
            continue
        camera = (cameras or {}).get(pair.sensor)
        rows = np.flatnonzero(np.isfinite(raw.pixels).any(axis=(1, 2)))
        both = candidates_of(
            camera or problem.cameras[pair.sensor],
            problem.boards[pair.target],
            raw.pixels[rows],
            problem.corner_px or 0.1,
            pair.label,
        )
        predicted = np.linalg.inv(Y[pair.sensor].matrix()) @ raw.A[rows] @ X[pair.target].matrix()
        T, covariance = both.chosen(both.nearer(predicted))
        changed = np.abs(T[:, :3, :3] - raw.B[rows, :3, :3]).max(axis=(1, 2)) > SAME_POSE
        number += int(changed.sum())
        if camera is not None:
            changed[:] = True
        if changed.any():
            every[pair] = _with_poses(raw, rows[changed], T[changed], covariance[changed])
    return (problem.with_measurements(every), number) if number or cameras else (problem, 0)


def _with_poses(raw: Measurements, rows: np.ndarray, T: Array, covariance: Array) -> Measurements:
    """Measurements with other poses and covariances in some rows."""
    assert raw.covariances is not None
    B, covariances = raw.B.copy(), raw.covariances.copy()
    B[rows], covariances[rows] = T, covariance
    spread = np.einsum("nii->ni", covariances)
    return replace(
        raw,
        B=B,
        sigma=np.sqrt(spread[:, 3:].mean(axis=1)),
        kappa=0.5 / spread[:, :3].mean(axis=1),
        covariances=covariances,
    )
