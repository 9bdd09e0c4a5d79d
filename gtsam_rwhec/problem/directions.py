"""Measurements that weigh by direction: what users give (points, planes), and the weights of the certified form.

Each is a pose B with a covariance whose meaningless directions have a very large variance. Its weights are those of the
residuals E = R_A R_X - R_Y R_B and e = R_A t_X + alpha t_A - t_Y - R_Y t_B (design fact 26)::

    1/2 |E V diag(m)^(1/2)|^2 + 1/2 |diag(l)^(1/2) L' R_X' R_A' (e + E c)|^2

V and m in the target's frame weigh rotations. c is the point of the target at which rotation and translation tell least
of each other, so a sphere's centre counts whole, whatever the frame's origin is.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from rwhec_factors.se3 import hat

from gtsam_rwhec.errors import CountError, NoiseError, PoseError
from gtsam_rwhec.files.terminal_text import brief
from gtsam_rwhec.geometry.poses import Array, PosesLike, QuaternionOrder
from gtsam_rwhec.geometry.real_numbers import is_between, real_array
from gtsam_rwhec.problem.measurements import LARGEST_WEIGHT, SMALLEST_WEIGHT, GivenMeasurements, Kind, Measurements

#: Standard deviations of directions that mean nothing, rad and m: their information is lost beside any other.
MEANINGLESS_RAD = 100.0
MEANINGLESS_M = 100.0
#: Which directions [omega, v] of a target's own axes a kind of measurement does not see.
UNSEEN = {
    Kind.POSE: np.zeros(6, dtype=bool),
    Kind.DIRECTIONAL: np.zeros(6, dtype=bool),
    Kind.POINT: np.array([True, True, True, False, False, False]),
    Kind.PLANE: np.array([False, False, True, True, True, False]),
}
#: A normal's length may differ from 1 by this.
LENGTH_TOLERANCE = 1e-3


def points_as_given(
    A: PosesLike,
    points: ArrayLike,
    sigma: ArrayLike | None,
    covariances: ArrayLike | None,
    order: QuaternionOrder | None,
    stamps_ns: ArrayLike | None,
    source: str | None,
    where: str,
) -> GivenMeasurements:
    """Points (N, 3) as measurements of poses."""
    p = _vectors(points, "points", where)
    N = len(p)
    if (sigma is None) == (covariances is None):
        raise NoiseError(
            f"{where}: give sigma (m, along each axis) or covariances (3 x 3, m^2) of the points, one of both"
        )
    if covariances is None:
        spread = _deviations(sigma, N, "sigma", where)[:, None, None] ** 2 * np.eye(3)
    else:
        spread = _checked_spread(covariances, N, where)
    B, noise = np.tile(np.eye(4), (N, 1, 1)), np.zeros((N, 6, 6))
    B[:, :3, 3] = p
    noise[:, :3, :3] = MEANINGLESS_RAD**2 * np.eye(3)
    noise[:, 3:, 3:] = spread
    return GivenMeasurements(A, B, None, None, order, stamps_ns, noise, source, kind=Kind.POINT)


def planes_as_given(
    A: PosesLike,
    normals: ArrayLike,
    points_on_plane: ArrayLike,
    normal_rad: ArrayLike,
    offset_m: ArrayLike,
    order: QuaternionOrder | None,
    stamps_ns: ArrayLike | None,
    source: str | None,
    where: str,
) -> GivenMeasurements:
    """Planes by normals (N, 3) and points on them (N, 3) as measurements of poses."""
    n, p = _vectors(normals, "normals", where), _vectors(points_on_plane, "points_on_plane", where)
    N = len(n)
    if len(p) != N:
        raise CountError(f"{where}: {N} normals and {len(p)} points_on_plane; give one point for each normal")
    lengths = np.linalg.norm(n, axis=1)
    bad = np.flatnonzero(np.abs(lengths - 1.0) > LENGTH_TOLERANCE)
    if bad.size:
        raise PoseError(
            f"{where}: normal {bad[0]} has length {lengths[bad[0]]:.6g}; give unit vectors in the sensor's frame, all "
            "towards the same side of the plane"
        )
    B, noise = np.tile(np.eye(4), (N, 1, 1)), np.zeros((N, 6, 6))
    B[:, :3, :3], B[:, :3, 3] = frames_of(n / lengths[:, None]), p
    noise[:, 0, 0] = noise[:, 1, 1] = _deviations(normal_rad, N, "normal_rad", where) ** 2
    noise[:, 2, 2] = MEANINGLESS_RAD**2
    noise[:, 3, 3] = noise[:, 4, 4] = MEANINGLESS_M**2
    noise[:, 5, 5] = _deviations(offset_m, N, "offset_m", where) ** 2
    return GivenMeasurements(A, B, None, None, order, stamps_ns, noise, source, kind=Kind.PLANE)


def frames_of(normals: Array) -> Array:
    """Rotations (N, 3, 3) whose z is a unit normal (N, 3), and whose x is as near as may be to the first axis.

    Where the normal is near that axis, x is as near as may be to the second one.
    """
    along = np.where(np.abs(normals[:, :1]) < 0.9, np.eye(3)[0], np.eye(3)[1])
    x = along - np.einsum("ni,ni->n", along, normals)[:, None] * normals
    x /= np.linalg.norm(x, axis=1, keepdims=True)
    frames: Array = np.stack([x, np.cross(normals, x), normals], axis=2)
    return frames


def _vectors(values: ArrayLike, name: str, where: str) -> Array:
    try:
        array = np.array(real_array(values))
    except ValueError as error:
        raise CountError(f"{where}: {name} cannot be read as numbers ({error}); give (N, 3) numbers") from error
    if array.ndim != 2 or array.shape[1] != 3 or not len(array):
        raise CountError(f"{where}: {name} has shape {array.shape}; give (N, 3) in the sensor's frame, metres")
    bad = np.flatnonzero(~np.isfinite(array).all(axis=1))
    if bad.size:
        raise PoseError(f"{where}: row {bad[0]} of {name} is {array[bad[0]]}; leave out what was not measured")
    return array


def _deviations(value: ArrayLike | None, count: int, name: str, where: str) -> Array:
    """Standard deviations (count,)."""
    try:
        array = real_array(value)
    except ValueError as error:
        raise NoiseError(f"{where}: {name}={brief(value)} cannot be read as numbers ({error})") from error
    if array.shape not in ((), (count,)):
        raise CountError(f"{where}: {name} has shape {array.shape}; give one number, or one for each of {count}")
    bad = next((x for x in array.ravel().tolist() if not is_between(x, SMALLEST_WEIGHT, LARGEST_WEIGHT)), None)
    if bad is not None:
        raise NoiseError(f"{where}: {name} has {bad}; standard deviations are positive and finite")
    return np.broadcast_to(array, (count,))


def _checked_spread(covariances: ArrayLike, count: int, where: str) -> Array:
    """Covariances of points, (count, 3, 3); that they are positive definite is checked with the whole pose's."""
    try:
        array = real_array(covariances)
    except ValueError as error:
        raise NoiseError(f"{where}: covariances cannot be read as numbers ({error}); give 3 x 3 matrices") from error
    if array.shape not in ((3, 3), (count, 3, 3)):
        raise CountError(f"{where}: covariances has shape {array.shape}; give (3, 3) or ({count}, 3, 3), m^2")
    return np.broadcast_to(array, (count, 3, 3))


#: A direction with less than this part of the largest information of its block tells nothing.
SEEN = 1e-6


@dataclass(frozen=True)
class Weighing:
    """Weights of N measurements, in the target's frame; columns of ``turns`` and ``axes`` are directions."""

    turns: Array  #: V (N, 3, 3)
    of_turns: Array  #: m (N, 3)
    centre: Array  #: c (N, 3)
    axes: Array  #: L (N, 3, 3)
    of_axes: Array  #: l (N, 3)
    mean: Array  #: (N,): the weight of translations where no direction is known

    @staticmethod
    def of(raw: Measurements) -> Weighing:
        """The weights of measurements.

        The rotation information I weighs with M = tr(I) / 2 - I. M has no negative weight: an axis that is known better
        than the two others together counts as well as these.
        """
        noise = raw.covariance_of_B()
        of_rotation, crossed = noise[:, :3, :3], noise[:, 3:, :3]
        # The c with the smallest E |v + omega x c|^2: (tr(S) - S) c = -E v x omega.
        moment = np.stack([crossed[:, j, k] - crossed[:, k, j] for j, k in ((1, 2), (2, 0), (0, 1))], axis=1)
        arm = np.einsum("nii->n", of_rotation)[:, None, None] * np.eye(3) - of_rotation
        centre = -np.linalg.solve(arm, moment[:, :, None])[:, :, 0]
        moved = np.concatenate([-hat(centre), np.broadcast_to(np.eye(3), (len(centre), 3, 3))], axis=2)
        there = moved @ noise @ moved.transpose(0, 2, 1)
        information, turns = np.linalg.eigh(np.linalg.inv(of_rotation))
        information[:, 2] = np.minimum(information[:, 2], information[:, 0] + information[:, 1])
        of_turns = np.maximum(0.5 * information.sum(axis=1, keepdims=True) - information, 0.0)
        variances, axes = np.linalg.eigh(0.5 * (there + there.transpose(0, 2, 1)))
        of_axes, mean = 1.0 / variances, 3.0 / variances.sum(axis=1)
        kinds = raw.kinds if raw.kinds is not None else np.zeros(len(centre), dtype=np.int8)
        is_point, is_plane, z = kinds == Kind.POINT, kinds == Kind.PLANE, np.array([0.0, 0.0, 1.0])
        of_turns[is_point] = centre[is_point] = 0.0
        turns[is_plane] = axes[is_plane] = np.eye(3)
        of_turns[is_plane] = 2.0 / np.einsum("nii->n", of_rotation[is_plane, :2, :2])[:, None] * z
        of_axes[is_plane] = 1.0 / there[is_plane, 2, 2, None] * z
        return Weighing(turns, of_turns, centre, axes, of_axes, mean)

    @property
    def equations(self) -> tuple[int, int]:
        """How many directions of rotation and of translation the measurements tell."""
        told = self.of_turns.sum(axis=1, keepdims=True) - self.of_turns, self.of_axes
        seen = [(each > 0.0) & (each >= SEEN * each.max(axis=1, keepdims=True)) for each in told]
        return int(seen[0].sum()), int(seen[1].sum())


def unseen_by(raw: Measurements) -> np.ndarray:
    """(6,): which directions of the target's frame none of the measurements sees."""
    if raw.kinds is None:
        return UNSEEN[Kind.POSE]
    return np.logical_and.reduce([UNSEEN[Kind(kind)] for kind in np.unique(raw.kinds)])
