"""Calibration by reprojection errors: corners in pixels replace the measured poses of A X = Y B.

A camera sees a target's corner p at the pixel of Y^-1 A X p, with the image's A. The cost is the sum of squared
reprojection errors over all corners, images, cameras and targets. Evangelista et al. 2023 and, for known intrinsics,
Tabb and Ahmad Yousef's rp1 minimise this cost over all X and Y.
"""

from __future__ import annotations

from dataclasses import dataclass

import gtsam
import numpy as np
from rwhec_factors import se3

from gtsam_rwhec.errors import CameraError
from gtsam_rwhec.geometry.poses import (
    Array,
    one_transform,
    to_pose3,
)
from gtsam_rwhec.methods.estimate import Poses
from gtsam_rwhec.methods.levenberg_marquardt import Linearised, descend
from gtsam_rwhec.methods.linear_methods import start_of
from gtsam_rwhec.methods.method import MethodOptions, checked_start
from gtsam_rwhec.reprojection.observations import Observations

#: In this many rounds, the calibration of the round before chooses between a flat target's two poses.
ROUNDS = 3


@dataclass(frozen=True)
class ReprojectionAnswer:
    """Where the descent ended.

    Attributes
    ----------
    X, Y : dict of str to gtsam.Pose3
        T_targetcarrier_target and T_sensorcarrier_sensor, metres.
    cost : float
        Half the sum of squared reprojection errors over corner_px^2.
    rms_px : float
        Root mean square length of the corners' reprojection errors, pixels.
    iterations : int
    converged : bool
    starts_from : str
        What the descent started from.
    """

    X: dict[str, gtsam.Pose3]
    Y: dict[str, gtsam.Pose3]
    cost: float
    rms_px: float
    iterations: int
    converged: bool
    starts_from: str


def calibrate(observations: Observations, options: MethodOptions | None = None) -> ReprojectionAnswer:
    """Minimise the reprojection error over all X and Y, by Levenberg-Marquardt on the manifold.

    Without a start in the options, the descent starts at a closed form's answer (``linear_methods.start_of``) for the
    images' poses. A flat target has two poses in an image; this answer chooses between them.

    Raises
    ------
    CameraError
        When the start puts a corner that was seen behind its camera.
    UnderdeterminedError
        When the closed form finds that the motions do not determine the poses.
    """
    options = options or MethodOptions()
    targets, sensors = observations.targets, observations.sensors
    X, Y, starts_from = _start(observations, options)
    starts = [(name, X[name]) for name in targets] + [(name, Y[name]) for name in sensors]
    T = np.array([one_transform(pose, f"start of {name}") for name, pose in starts])
    if not np.isfinite(linearised(observations, T).cost):
        raise CameraError(
            f"the start ({starts_from}) puts a corner that was seen behind its camera; give a better start by "
            "MethodOptions.start"
        )
    found = descend(
        lambda poses: linearised(observations, poses),
        lambda poses, step: poses @ se3.expmap(step.reshape(-1, 6)),
        T,
        options.max_iterations,
    )
    poses = [to_pose3(pose[:3, :3], pose[:3, 3]) for pose in found.point]
    corners = sum(int(view.known.sum()) for view in observations.views.values())
    return ReprojectionAnswer(
        dict(zip(targets, poses[: len(targets)], strict=True)),
        dict(zip(sensors, poses[len(targets) :], strict=True)),
        found.cost,
        float(observations.corner_px * np.sqrt(2.0 * found.cost / corners)),
        found.iterations,
        found.converged,
        starts_from,
    )


def _start(observations: Observations, options: MethodOptions) -> tuple[Poses, Poses, str]:
    if options.start is not None:
        X, Y, _ = checked_start(observations.targets, observations.sensors, options.start)
        return X, Y, "the given start"
    problem = observations.poses()
    for _ in range(ROUNDS):
        X, Y, _, _ = start_of(problem, options)
        predicted = {
            (target, sensor): np.linalg.inv(np.asarray(Y[sensor])) @ view.A @ np.asarray(X[target])
            for (target, sensor), view in observations.views.items()
        }
        problem = observations.poses(predicted)
    X, Y, _, words = start_of(problem, options)
    return X, Y, f"{words} of the images' poses"


def linearised(observations: Observations, T: Array) -> Linearised:
    """Half the sum of squares over corner_px^2 at poses T (n_X + n_Y, 4, 4), for right perturbations [w, v] of each.

    The cost is infinite where a corner that was seen is behind its camera.
    """
    targets, sensors = observations.targets, observations.sensors
    H, g = np.zeros((6 * len(T), 6 * len(T))), np.zeros(6 * len(T))
    cost = 0.0
    for (target, sensor), view in observations.views.items():
        i, j = targets.index(target), len(targets) + sensors.index(sensor)
        camera, p = observations.cameras[sensor], observations.corners[target]
        to_camera = np.linalg.inv(T[j]) @ view.A @ T[i]
        R = to_camera[:, :3, :3]
        seen = p @ R.transpose(0, 2, 1) + to_camera[:, None, :3, 3]
        known = view.known
        if (seen[known][:, 2] <= 1e-9).any():
            return Linearised(np.inf, g, H)
        z = np.where(known, seen[:, :, 2], 1.0)
        x = np.where(known[:, :, None], seen[:, :, :2] / z[:, :, None], 0.0)
        pixels, D = camera.pixel_jacobian(x)
        # d(x, y) / d(X, Y, Z) = [I, -x] / Z
        to_x = np.concatenate([np.broadcast_to(np.eye(2), (*x.shape, 2)), -x[..., None]], axis=-1) / z[..., None, None]
        by_point = np.where(known[:, :, None, None], D @ to_x, 0.0) / observations.corner_px
        error = np.where(known[:, :, None], pixels - view.pixels, 0.0) / observations.corner_px
        # X Expmap([w, v]) moves the point by R (w x p + v), Y Expmap([w, v]) by -(w x P + v).
        J_X = by_point @ (R[:, None] @ np.concatenate([-se3.hat(p), np.tile(np.eye(3), (len(p), 1, 1))], axis=2))
        at_P = np.concatenate([se3.hat(seen), np.broadcast_to(-np.eye(3), (*seen.shape, 3))], axis=-1)
        rows, e = np.concatenate([J_X, by_point @ at_P], axis=-1).reshape(-1, 12), error.ravel()
        at = np.r_[6 * i : 6 * i + 6, 6 * j : 6 * j + 6]
        H[np.ix_(at, at)] += rows.T @ rows
        g[at] += rows.T @ e
        cost += 0.5 * float(e @ e)
    return Linearised(cost, g, H)
