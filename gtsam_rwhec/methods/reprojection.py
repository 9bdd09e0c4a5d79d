"""Calibration by reprojection errors: corners in pixels replace the measured poses of A X = Y B.

A camera sees a target's corner p at the pixel of Y^-1 A X p, with the image's A. The cost is the sum of squared
reprojection errors over all corners, images, cameras and targets. Evangelista et al. 2023 and, for known intrinsics,
Tabb and Ahmad Yousef's rp1 minimise this cost over all X and Y.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import gtsam
import numpy as np
from numpy.typing import ArrayLike
from rwhec_factors import se3

from gtsam_rwhec.errors import CameraError, CountError, FrameError, NoiseError, TargetError
from gtsam_rwhec.geometry.poses import (
    Array,
    PosesLike,
    as_transforms,
    checked_rows,
    one_transform,
    rows_to_transforms,
    to_pose3,
)
from gtsam_rwhec.methods.estimate import Poses
from gtsam_rwhec.methods.levenberg_marquardt import Linearised, descend
from gtsam_rwhec.methods.linear_methods import start_of
from gtsam_rwhec.methods.method import MethodOptions, checked_start
from gtsam_rwhec.problem.problem import Problem
from gtsam_rwhec.vision.camera import Camera

#: In this many rounds, the calibration of the round before chooses between a flat target's two poses.
ROUNDS = 3
#: A target is flat when its corners are no farther from a plane than this share of its size.
FLAT = 1e-6


@dataclass(frozen=True, eq=False)
class Views:
    """Images of one target by one camera: A (N, 4, 4), metres; pixels (N, n, 2), nan where a corner was not seen."""

    A: Array
    pixels: Array

    @property
    def known(self) -> np.ndarray:
        """(N, n) booleans: which corners were seen."""
        return np.asarray(np.isfinite(self.pixels).all(axis=2))


@dataclass(frozen=True, eq=False)
class Observations:
    """What cameras saw.

    Attributes
    ----------
    cameras : dict of str to Camera
        By sensor.
    corners : dict of str to (n, 3) array
        By target, in its own frame, metres.
    views : dict of (target, sensor) to Views
    corner_px : float
        Standard deviation of a corner along each axis, pixels.
    """

    cameras: Mapping[str, Camera]
    corners: Mapping[str, Array]
    views: Mapping[tuple[str, str], Views]
    corner_px: float = 0.1

    @staticmethod
    def of(
        cameras: Mapping[str, Camera],
        corners: Mapping[str, ArrayLike],
        views: Mapping[tuple[str, str], tuple[PosesLike, ArrayLike]],
        corner_px: float = 0.1,
    ) -> Observations:
        """Make checked observations; views are given as A = T_sensorcarrier_targetcarrier and pixels of each image.

        Raises
        ------
        CountError, FrameError, NoiseError, PoseError, TargetError
            When shapes do not fit, a name has no camera or target, or a matrix is not a pose.
        """
        if not (np.isfinite(corner_px) and corner_px > 0.0):
            raise NoiseError(f"corner_px is {corner_px!r}; give a positive number of pixels")
        points = {name: np.asarray(value, dtype=float) for name, value in corners.items()}
        for name, p in points.items():
            if p.ndim != 2 or p.shape[1] != 3 or len(p) < 4 or not np.isfinite(p).all():
                raise TargetError(f"the corners of {name} have shape {p.shape}; give four or more finite (n, 3) points")
        checked = {}
        for (target, sensor), (A, pixels) in views.items():
            where = f"the views of {target} by {sensor}"
            if target not in points or sensor not in cameras:
                missing = f"corners of {target}" if target not in points else f"camera {sensor}"
                raise FrameError(f"{where}: there are no {missing}")
            transforms = as_transforms(A, None, f"A of {where}")
            seen = np.asarray(pixels, dtype=float)
            if seen.shape != (len(transforms), len(points[target]), 2) or not len(seen):
                raise CountError(
                    f"{where}: pixels have shape {seen.shape} for {len(transforms)} poses and {len(points[target])} "
                    f"corners; give ({len(transforms)}, {len(points[target])}, 2), nan where a corner was not seen"
                )
            fewest = int(np.isfinite(seen).all(axis=2).sum(axis=1).min())
            if fewest < 4:
                raise CountError(f"{where}: an image has {fewest} corners; leave out images with fewer than 4")
            rows = checked_rows(transforms, 0, f"A of {where}").rows
            checked[target, sensor] = Views(rows_to_transforms(rows), seen)
        if not checked:
            raise CountError("there are no views; give images of a target by a camera")
        return Observations(dict(cameras), points, checked, float(corner_px))

    @property
    def targets(self) -> tuple[str, ...]:
        """Names of the targets that were seen."""
        return tuple(dict.fromkeys(target for target, _ in self.views))

    @property
    def sensors(self) -> tuple[str, ...]:
        """Names of the cameras that saw a target."""
        return tuple(dict.fromkeys(sensor for _, sensor in self.views))

    def poses(self, predicted: Mapping[tuple[str, str], Array] | None = None) -> Problem:
        """A problem of poses: each image's pose by its corners alone, with covariances.

        ``predicted`` has each image's T_camera_target (N, 4, 4) by a calibration, metres: the image takes the nearer of
        a flat target's two poses. Left out, each image takes the pose with less reprojection error. Raises TargetError
        when a target is not flat, and CameraError when an image's corners have no pose.
        """
        from gtsam_rwhec.vision.pose import plane_poses

        problem = Problem()
        for (target, sensor), view in self.views.items():
            flat, T_target_flat = _in_plane(self.corners[target], target)
            known = view.known
            found = plane_poses(
                self.cameras[sensor],
                [flat[seen] for seen in known],
                [pixels[seen] for pixels, seen in zip(view.pixels, known, strict=True)],
                corner_px=self.corner_px,
            )
            T = found.T @ np.linalg.inv(T_target_flat)
            choice = np.zeros(len(T), dtype=int)
            if predicted is not None:
                off = np.linalg.norm(T[:, :, :3, :3] - predicted[target, sensor][:, None, :3, :3], axis=(2, 3))
                choice = np.where(np.isnan(off[:, 1]), 0, np.argmin(np.nan_to_num(off, nan=np.inf), axis=1))
            at = np.arange(len(T))
            lost = np.flatnonzero(~np.isfinite(T[at, choice]).all(axis=(1, 2)))
            if lost.size:
                raise CameraError(f"image {lost[0]} of {target} by {sensor} has no pose: are its corners on one line?")
            # right perturbations of the flat frame become right perturbations of the target's frame by the adjoint
            ad = se3.adjoint(np.broadcast_to(T_target_flat, (len(T), 4, 4)))
            covariance = ad @ found.covariance[at, choice] @ ad.mT
            problem.add(target, sensor, view.A, T[at, choice], covariances=0.5 * (covariance + covariance.mT))
        return problem


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


def _in_plane(points: Array, name: str) -> tuple[Array, Array]:
    """A flat target's corners with z = 0, and T_target_flat; TargetError for a target that is not flat."""
    middle = points.mean(axis=0)
    _, singular, Vt = np.linalg.svd(points - middle)
    if singular[2] > FLAT * singular[0]:
        raise TargetError(
            f"the corners of {name} do not lie in one plane (the root mean square distance is "
            f"{singular[2] / np.sqrt(len(points)):.3g} m), and only flat targets have poses from "
            "single images; give a start by MethodOptions.start"
        )
    if singular[1] <= FLAT * singular[0]:
        raise TargetError(f"the corners of {name} lie on one line, which determines no pose; give corners in a plane")
    R = Vt.T * np.array([1.0, 1.0, np.linalg.det(Vt)])
    flat = (points - middle) @ R
    flat[:, 2] = 0.0
    return flat, se3.pose(R, middle)
