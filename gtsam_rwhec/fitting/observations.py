"""What cameras saw: corners of targets in pixels, with the carriers' pose of each image."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import TypeVar

import numpy as np
from numpy.typing import ArrayLike
from rwhec_factors import se3

from gtsam_rwhec.cameras.camera import Camera
from gtsam_rwhec.cameras.unknown_intrinsics import Lens, estimated_intrinsics
from gtsam_rwhec.errors import CameraError, CountError, FrameError, NoiseError, OptionError, TargetError
from gtsam_rwhec.files.terminal_text import natural_key
from gtsam_rwhec.fitting.pair_data import local_paths
from gtsam_rwhec.geometry.poses import (
    Array,
    PoseLike,
    PosesLike,
    as_transforms,
    checked_rows,
    one_transform,
    rows_to_transforms,
)
from gtsam_rwhec.geometry.trajectory import Trajectory
from gtsam_rwhec.problem.corners import check_in_image
from gtsam_rwhec.problem.measurements import Pair
from gtsam_rwhec.problem.problem import Problem

#: A target is flat when its corners are no farther from a plane than this share of its size.
FLAT = 1e-6


@dataclass(frozen=True, eq=False)
class Views:
    """Images of one target by one camera."""

    #: (N, 4, 4): T_sensorcarrier_targetcarrier of each image, metres.
    A: Array
    #: (N, n, 2): nan where a corner was not seen.
    pixels: Array
    #: (N, 6): The carriers' velocity at each image, [omega rad/s, v m/s] in the target carrier's axes: A(t + d) = A
    #: Expmap(d twist). A time offset needs it.
    twist: Array | None = None

    @property
    def known(self) -> np.ndarray:
        """(N, n) booleans: which corners were seen."""
        return np.asarray(np.isfinite(self.pixels).all(axis=2))

    def selected(self, which: np.ndarray) -> Views:
        """The images that a mask or an index array selects."""
        return Views(self.A[which], self.pixels[which], None if self.twist is None else self.twist[which])


@dataclass(frozen=True, eq=False)
class Observations:
    """What cameras saw."""

    #: By sensor.
    cameras: Mapping[str, Camera]
    #: (n, 3) each. By target, in its own frame, metres.
    corners: Mapping[str, Array]
    views: Mapping[tuple[str, str], Views]
    #: Standard deviation of a corner along each axis, pixels.
    corner_px: float = 0.1

    @staticmethod
    def of(
        cameras: Mapping[str, Camera],
        corners: Mapping[str, ArrayLike],
        views: Mapping[tuple[str, str], tuple[PosesLike, ArrayLike] | tuple[PosesLike, ArrayLike, ArrayLike | None]],
        corner_px: float = 0.1,
    ) -> Observations:
        """Make checked observations.

        Views are given as A = T_sensorcarrier_targetcarrier and pixels of each image, and the carriers' velocity there
        (`Views.twist`) where it is known.

        Raises
        ------
        CameraError, CountError, FrameError, NoiseError, PoseError, TargetError
            When shapes do not fit, a name has no camera or target, a corner is outside its image, or a matrix is not a
            pose.
        """
        if not (np.isfinite(corner_px) and corner_px > 0.0):
            raise NoiseError(f"corner_px is {corner_px!r}; give a positive number of pixels")
        points = {name: np.asarray(value, dtype=float) for name, value in corners.items()}
        for name, p in points.items():
            if p.ndim != 2 or p.shape[1] != 3 or len(p) < 4 or not np.isfinite(p).all():
                raise TargetError(f"the corners of {name} have shape {p.shape}; give four or more finite (n, 3) points")
        checked = {}
        for (target, sensor), (A, pixels, *velocity) in views.items():
            where = f"the views of {target} by {sensor}"
            if target not in points or sensor not in cameras:
                missing = (
                    f"are no corners of {target}; give its board in corners, (n, 3) points in its frame, metres, such "
                    "as rw.cameras.Checkerboard(...).corners()"
                    if target not in points
                    else f"is no camera {sensor}; give its intrinsics in cameras"
                )
                raise FrameError(f"{where}: there {missing}")
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
            check_in_image(seen, cameras[sensor], where)
            rows = checked_rows(transforms, 0, f"A of {where}").rows
            twist = None if not velocity or velocity[0] is None else np.asarray(velocity[0], dtype=float)
            if twist is not None and not (twist.shape == (len(transforms), 6) and np.isfinite(twist).all()):
                raise CountError(
                    f"{where}: velocities have shape {twist.shape}, finite: {bool(np.isfinite(twist).all())}; give "
                    f"({len(transforms)}, 6) finite numbers [omega rad/s, v m/s], or None"
                )
            checked[target, sensor] = Views(rows_to_transforms(rows), seen, twist)
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
        problem = Problem()
        choices = self.choices(predicted)
        for (target, sensor), view in self.views.items():
            T, covariance = self._candidates[target, sensor]
            at, choice = np.arange(len(T)), choices[target, sensor]
            lost = np.flatnonzero(~np.isfinite(T[at, choice]).all(axis=(1, 2)))
            if lost.size:
                raise CameraError(
                    f"image {lost[0]} of {target} by {sensor} has no pose: "
                    + _why_no_pose(self.cameras[sensor], view.pixels[lost[0]], sensor)
                )
            problem.add(target, sensor, view.A, T[at, choice], covariances=covariance[at, choice])
        return problem

    def choices(self, predicted: Mapping[tuple[str, str], Array] | None = None) -> dict[tuple[str, str], np.ndarray]:
        """Which of its two poses (N,) each image takes in `poses`: 0 is the one with less reprojection error."""
        found = {}
        for pair in self.views:
            T, _ = self._candidates[pair]
            found[pair] = np.zeros(len(T), dtype=int)
            if predicted is not None:
                off = np.linalg.norm(T[:, :, :3, :3] - predicted[pair][:, None, :3, :3], axis=(2, 3))
                found[pair] = np.where(np.isnan(off[:, 1]), 0, np.argmin(np.nan_to_num(off, nan=np.inf), axis=1))
        return found

    @cached_property
    def _candidates(self) -> dict[tuple[str, str], tuple[Array, Array]]:
        """Each image's two poses (N, 2, 4, 4), nan where there is none, and their covariances (N, 2, 6, 6)."""
        from gtsam_rwhec.cameras.target_poses import plane_poses

        result: dict[tuple[str, str], tuple[Array, Array]] = {}
        flat = {name: in_plane(self.corners[name], name) for name in self.targets}
        alike: dict[tuple[str, int], list[tuple[str, str]]] = {}  # of one camera and as many corners: all at once
        for target, sensor in self.views:
            alike.setdefault((sensor, len(self.corners[target])), []).append((target, sensor))
        for (sensor, _), pairs in alike.items():
            camera = self.cameras[sensor]
            known = {pair: self.views[pair].known & camera.has_ray(self.views[pair].pixels) for pair in pairs}
            found = plane_poses(
                camera,
                [flat[pair[0]][0][seen] for pair in pairs for seen in known[pair]],
                [px[seen] for pair in pairs for px, seen in zip(self.views[pair].pixels, known[pair], strict=True)],
                corner_px=self.corner_px,
            )
            ends = np.cumsum([len(known[pair]) for pair in pairs])[:-1]
            for pair, T, C in zip(pairs, np.split(found.T, ends), np.split(found.covariance, ends), strict=True):
                T_target_flat = flat[pair[0]][1]
                # right perturbations of the flat frame become right perturbations of the target's frame by the adjoint
                ad = se3.adjoint(T_target_flat[None])[0]
                covariance = ad @ C @ ad.T
                result[pair] = T @ se3.inverse(T_target_flat), 0.5 * (covariance + covariance.mT)
        return result


def _why_no_pose(camera: Camera, pixels: Array, sensor: str) -> str:
    """Why the corners (n, 2) of an image have no pose."""
    dark = int((~camera.has_ray(pixels)).sum())
    if not dark:
        return "are its corners on one line?"
    return (
        f"the lens model of {sensor} ({camera.model}) has no ray for {dark} of its {np.isfinite(pixels[:, 0]).sum()} "
        "corners, since its distortion folds back; check D, its order and its model, or state the intrinsics as "
        "'unknown'"
    )


def in_plane(points: Array, name: str) -> tuple[Array, Array]:
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


def observations_of(
    problem: Problem,
    *,
    scale: float | Mapping[str, float] = 1.0,
    time_offsets_s: Mapping[str, float] | None = None,
    carrier_path: Trajectory | None = None,
) -> Observations:
    """What cameras saw: the corners of a problem, in the order of its measurements.

    Parameters
    ----------
    problem : Problem
        Every measurement was added with ``add_corners``.
    scale : float or dict of str to float
        Stated over true length of the targets (`Refined.scale`): the boards have true sizes in the observations.
    time_offsets_s : dict of str to float, optional
        By sensor: A is taken that much later than the stamps, along the carriers' motion; views have its velocity.
    carrier_path : Trajectory, optional
        The carriers' motion, as in `RefineOptions`.

    Raises
    ------
    CountError
        The problem has no corners, or not of every measurement; or time offsets, and no motion of the carriers.
    MeasurementsNotKeptError
        Raw measurements were not kept.
    """
    check_corners_everywhere(problem)
    late = dict(time_offsets_s or {})
    paths = local_paths(problem, tuple(late), carrier_path)
    views: dict[tuple[str, str], Views] = {}
    for pair in problem.pairs:
        raw = problem.measurements(*pair)
        assert raw.pixels is not None
        A, twist = raw.A, None
        if pair in paths:
            A, twist = A @ paths[pair].motion(late[pair.sensor]), paths[pair].twists(late[pair.sensor])
        views[pair.target, pair.sensor] = Views(A, raw.pixels, twist)
    of = scale if isinstance(scale, Mapping) else dict.fromkeys(problem.targets, scale)
    boards = {name: board / of.get(name, 1.0) for name, board in problem.boards.items()}
    return Observations(dict(problem.cameras), boards, views, problem.corner_px or 0.1)


def check_corners_everywhere(problem: Problem) -> None:
    """A CountError where a measurement of the problem has no corners; it says of which pairs."""
    if not problem.boards:
        raise CountError(
            "the problem has no corners; add images with problem.add_corners(target, sensor, A, image_points, "
            "board_points, camera), or refine from poses (observations='poses')"
        )
    problem.require_raw_measurements("a refinement from corners")
    lacking = {}
    for pair in problem.pairs:
        pixels = problem.measurements(*pair).pixels
        count = problem.moments(*pair).count
        without = count if pixels is None else int(np.isnan(pixels).all(axis=(1, 2)).sum())
        if without:
            lacking[pair] = f"{pair} ({without} of {count})"
    if lacking:
        named = ", ".join(lacking[pair] for pair in sorted(lacking, key=_natural))
        raise CountError(
            f"measurements without corners: {named}. A refinement from corners takes no poses beside them: add these "
            "with add_corners too, leave them out, or refine from poses (observations='poses')"
        )


def check_corners_can_hold(problem: Problem) -> None:
    """An OptionError where the problem states what a refinement from corners does not hold."""
    stated = [f"the fixed pose of {name}" for name in problem.fixed]
    stated += [f"the prior of {name}" for name in problem.priors]
    if problem.scale == "shared":
        stated.append("one scale of all lengths (scale='shared'; 'per_target' estimates the boards' sizes)")
    if stated:
        raise OptionError(
            f"a refinement from corners does not hold {', '.join(stated)}; leave it out, or refine from poses "
            "(observations='poses')"
        )


def _natural(pair: Pair) -> tuple[object, ...]:
    return natural_key(pair.label)


def first_intrinsics(observations: Observations, sensor: str) -> Camera:
    """A camera's intrinsics from its views of flat targets alone, with the lens model that is stated.

    A stated pinhole gets four coefficients of distortion, zero where the corners do not ask for them. Raises
    `CameraError` where the views are too few, or do not determine intrinsics.
    """
    stated = observations.cameras[sensor]
    points, pixels = _views(observations, sensor)
    lens: Lens = "radtan" if stated.model == "pinhole" else stated.model
    try:
        found = estimated_intrinsics(points, pixels, (stated.width, stated.height), lens).camera
    except CameraError as error:
        raise CameraError(f"the intrinsics of {sensor} {error}. Or state intrinsics") from error
    if found.model == "pinhole":
        return Camera(found.width, found.height, "radtan", found.K, np.zeros(4))
    return found


def _views(observations: Observations, sensor: str) -> tuple[list[Array], list[Array]]:
    """Corners in their plane and their pixels, of each view."""
    points, pixels = [], []
    for (target, name), view in observations.views.items():
        if name != sensor:
            continue
        flat, _ = in_plane(observations.corners[target], target)
        for seen, known in zip(view.pixels, view.known, strict=True):
            points.append(flat[known])
            pixels.append(seen[known])
    return points, pixels


Answer = TypeVar("Answer")
#: In at most so many rounds the calibration of the round before chooses between the two poses.
ROUNDS = 3


def solved_with_chosen_poses(
    observations: Observations,
    solve: Callable[[Problem], Answer],
    poses_of: Callable[[Answer], tuple[Mapping[str, PoseLike], Mapping[str, PoseLike]]],
) -> Answer:
    """An answer for the images' poses, chosen by the answer of the round before; the rounds end when no choice changes.

    `poses_of` has an answer's X and Y. Raises what `Observations.poses` and `solve` do.
    """
    answer, choices = solve(observations.poses()), observations.choices()
    for _ in range(ROUNDS - 1):
        X, Y = poses_of(answer)
        predicted = {
            (target, sensor): se3.inverse(one_transform(Y[sensor], sensor)) @ view.A @ one_transform(X[target], target)
            for (target, sensor), view in observations.views.items()
        }
        before, choices = choices, observations.choices(predicted)
        if all(np.array_equal(before[pair], choices[pair]) for pair in choices):
            break
        answer = solve(observations.poses(predicted))
    return answer
