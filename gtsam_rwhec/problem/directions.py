"""Measurements that weigh by direction: what users give (points, planes), and the weights of the certified form.

Each is a pose B with a covariance whose meaningless directions have a very large variance. Its weights are those of the
residuals E = R_A R_X - R_Y R_B and e = R_A t_X + alpha t_A - t_Y - R_Y t_B (design fact 26)::

    1/2 |E V diag(m)^(1/2)|^2 + 1/2 |diag(l)^(1/2) L' R_X' R_A' (e + E c)|^2

V and m in the target's frame weigh rotations. c is the point of the target at which rotation and translation tell least
of each other, so a sphere's centre counts whole, whatever the frame's origin is.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike
from rwhec_factors import se3

from gtsam_rwhec.errors import CountError, NoiseError, PoseError
from gtsam_rwhec.files.terminal_text import brief
from gtsam_rwhec.geometry.poses import Array, PosesLike, QuaternionOrder
from gtsam_rwhec.geometry.real_numbers import is_between, real_array
from gtsam_rwhec.problem.measurements import LARGEST_WEIGHT, SMALLEST_WEIGHT, GivenMeasurements, Kind, Measurements

#: Standard deviations of directions that mean nothing, rad and m: their information is lost beside any other.
MEANINGLESS_RAD = 30.0
MEANINGLESS_M = 30.0
#: Variances, rad^2 or m^2, from which on a direction slides: nothing that is measured is so rough.
SLIDES = 25.0
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
        spread: Array = _deviations(sigma, N, "sigma", where)[:, None, None] ** 2 * np.eye(3)
    else:
        spread = _checked_spread(covariances, N, where)
    B, noise = se3.pose(np.eye(3), p), np.zeros((N, 6, 6))
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
    B, noise = se3.pose(frames_of(n / lengths[:, None]), p), np.zeros((N, 6, 6))
    noise[:, 0, 0] = noise[:, 1, 1] = _deviations(normal_rad, N, "normal_rad", where) ** 2
    noise[:, 2, 2] = MEANINGLESS_RAD**2
    noise[:, 3, 3] = noise[:, 4, 4] = MEANINGLESS_M**2
    noise[:, 5, 5] = _deviations(offset_m, N, "offset_m", where) ** 2
    return GivenMeasurements(A, B, None, None, order, stamps_ns, noise, source, kind=Kind.PLANE)


def frames_of(normals: Array, along: Array | None = None) -> Array:
    """Rotations (N, 3, 3) whose z is a unit normal (N, 3), and whose x is as near as may be to ``along`` (N, 3).

    Left out, that is the first axis; the second one where the normal is near the first.
    """
    if along is None:
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
        of_rotation, crossed, centre = noise[:, :3, :3], noise[:, 3:, :3], centres_of(noise)
        is_point, is_plane, z = raw.is_of(Kind.POINT), raw.is_of(Kind.PLANE), np.array([0.0, 0.0, 1.0])
        centre[is_point] = 0.0
        # Of a plane only (omega x c)_z counts: where it tells least of its tilt.
        tilt = np.linalg.solve(of_rotation[is_plane, :2, :2], crossed[is_plane, 2, :2, None])[:, :, 0]
        centre[is_plane] = np.column_stack([tilt[:, 1], -tilt[:, 0], np.zeros(len(tilt))])
        moved = _moved(centre)[:, 3:]
        there = moved @ noise @ moved.transpose(0, 2, 1)
        information, turns = np.linalg.eigh(np.linalg.inv(of_rotation))
        information[:, 2] = np.minimum(information[:, 2], information[:, 0] + information[:, 1])
        of_turns = np.maximum(0.5 * information.sum(axis=1, keepdims=True) - information, 0.0)
        variances, axes = np.linalg.eigh(0.5 * (there + there.transpose(0, 2, 1)))
        of_axes, mean = 1.0 / variances, 3.0 / variances.sum(axis=1)
        of_turns[is_point] = 0.0
        turns[is_plane] = axes[is_plane] = np.eye(3)
        of_turns[is_plane] = 2.0 / np.einsum("nii->n", of_rotation[is_plane, :2, :2])[:, None] * z
        of_axes[is_plane] = 1.0 / there[is_plane, 2, 2, None] * z
        return Weighing(turns, of_turns, centre, axes, of_axes, mean)

    def holding_slides(self, slides: np.ndarray, part: float) -> Weighing:
        """The weights in which some measurements (N,) hold what they do not tell, with a part of their largest weight.

        Slid to where an answer predicts it, such a residual is zero there. Without a weight the target would slide off
        to where the rest of the noise fits better.
        """
        told = self.of_turns.sum(axis=1, keepdims=True) - self.of_turns
        held = []
        for weights in (told, self.of_axes):
            largest = weights.max(axis=1, keepdims=True)
            held.append(np.where(slides[:, None] & (weights < SEEN * largest), part * largest, weights))
        of_turns = np.maximum(0.5 * held[0].sum(axis=1, keepdims=True) - held[0], 0.0)
        return replace(self, of_turns=np.where(slides[:, None], of_turns, self.of_turns), of_axes=held[1])

    def without_slides(self, directional: np.ndarray) -> tuple[Array, Array]:
        """``of_turns`` and ``of_axes`` without what (N,) measurements state for what slides: that tells nothing."""
        least = np.where(directional, 1.0 / SLIDES, 0.0)[:, None]
        turns = self.of_turns.sum(axis=1, keepdims=True) - self.of_turns
        turns = np.where(turns <= least, 0.0, turns)
        of_turns = np.maximum(0.5 * turns.sum(axis=1, keepdims=True) - turns, 0.0)
        is_same = (turns > 0.0).all(axis=1, keepdims=True) | ~directional[:, None]
        of_axes = np.where(self.of_axes <= least, 0.0, self.of_axes)
        return np.where(is_same, self.of_turns, of_turns), of_axes

    @property
    def equations(self) -> tuple[int, int]:
        """How many directions of rotation and of translation the measurements tell."""
        told = self.of_turns.sum(axis=1, keepdims=True) - self.of_turns, self.of_axes
        seen = [(each > 0.0) & (each >= SEEN * each.max(axis=1, keepdims=True)) for each in told]
        return int(seen[0].sum()), int(seen[1].sum())


def aligned(raw: Measurements, X: Array, Y: Array, scale: float = 1.0) -> Measurements:
    """The measurements, each slid to where poses (4, 4) X and Y predict it, along what it does not measure.

    So a residual is small in every direction, and its directions turn with the target. A point's rotation is the
    predicted one; a plane's frame turns about its normal and moves in the plane; others slide along the eigenvectors
    of their covariance with a variance of at least ``SLIDES``. Covariances move along. ``scale``: measured over true
    length.
    """
    if raw.covariances is None or raw.kinds is None:
        return raw
    predicted = se3.inverse(Y)[None] @ raw.A @ X
    predicted[:, :3, 3] *= scale
    B, slid = raw.B, raw.B.copy()
    point, plane, other = (raw.is_of(kind) for kind in (Kind.POINT, Kind.PLANE, Kind.DIRECTIONAL))
    slid[point, :3, :3] = predicted[point, :3, :3]
    normal = B[plane, :3, 2]
    slid[plane, :3, :3] = frames_of(normal, predicted[plane, :3, 0])
    off = predicted[plane, :3, 3] - B[plane, :3, 3]
    slid[plane, :3, 3] += off - np.einsum("ni,ni->n", off, normal)[:, None] * normal
    covariances = raw.covariances
    if other.any():
        variances, along = np.linalg.eigh(covariances[other])
        free = along * (variances >= SLIDES)[:, None, :]
        step = free @ (free.transpose(0, 2, 1) @ se3.logmap(se3.inverse(B[other]) @ predicted[other])[:, :, None])
        slid[other] = B[other] @ se3.expmap(step[:, :, 0])
    moved = se3.adjoint(se3.inverse(slid) @ B)
    moved[raw.is_of(Kind.POSE)] = np.eye(6)
    covariances = moved @ covariances @ moved.transpose(0, 2, 1)
    for kind in (Kind.POINT, Kind.PLANE):  # what means nothing tells nothing of the rest
        mine, seen = raw.is_of(kind), ~UNSEEN[kind]
        stated = np.where(seen, 0.0, np.einsum("nii->ni", raw.covariances[mine]))
        covariances[mine] = covariances[mine] * (seen[:, None] & seen) + stated[:, :, None] * np.eye(6)
    return replace(raw, B=slid, covariances=0.5 * (covariances + covariances.transpose(0, 2, 1)))


def slides_of(raw: Measurements) -> Array | None:
    """The part of the covariances (N, 6, 6) that is of directions in which nothing is measured; None without any."""
    if raw.kinds is None or raw.covariances is None:
        return None
    slides = np.zeros_like(raw.covariances)
    for kind in (Kind.POINT, Kind.PLANE):
        mine = raw.is_of(kind)
        slides[mine] = np.where(UNSEEN[kind], np.einsum("nii->ni", raw.covariances[mine]), 0.0)[:, :, None] * np.eye(6)
    other = raw.is_of(Kind.DIRECTIONAL)
    slides[other] = sliding_part(raw.covariances[other])
    return slides


def sliding_part(covariances: Array) -> Array:
    """The part of covariances (N, 6, 6) that is of directions with a variance of at least ``SLIDES``."""
    variances, along = np.linalg.eigh(covariances)
    # A difference: what is left of an axis along which all slides is then zero, and not rounding.
    measured = (along * np.where(variances >= SLIDES, 0.0, variances)[:, None, :]) @ along.transpose(0, 2, 1)
    slides = np.where((variances[:, -1] >= SLIDES)[:, None, None], covariances - measured, 0.0)
    # Where every turn slides, no rounding of it is left to be taken for a measured turn.
    turns = np.linalg.eigvalsh(slides[:, :3, :3])[:, 0] > 0.5 * SLIDES
    for rows, columns in ((slice(0, 3), slice(0, 6)), (slice(0, 6), slice(0, 3))):
        slides[turns, rows, columns] = covariances[turns, rows, columns]
    return np.asarray(slides)


def scaled(covariances: Array, slides: Array | None, deviation: Array) -> Array:
    """Covariances (N, 6, 6) whose deviations are multiplied by (6,); what slides (N, 6, 6) slides as before.

    Where something slides or may slide, at the points where turns and shifts tell least of each other. Else these
    points would move away as one grows beside the other, and with them the residuals.
    """
    if slides is None:
        return np.asarray(covariances * deviation[:, None] * deviation)
    measured = covariances - slides
    there = _moved(centres_of(measured))
    back = np.linalg.inv(there)
    at_centre = there @ measured @ there.transpose(0, 2, 1) * deviation[:, None] * deviation
    return np.asarray(back @ at_centre @ back.transpose(0, 2, 1) + slides)


def shifted_and_turned(shift_m: float, turn_rad: float, B: Array) -> Array:
    """How a sensor is off, (6, 6), whose views B (N, 4, 4) of a thing are all shifted, and turned about it."""
    about = se3.hat(B[:, :3, 3].mean(axis=0))
    return np.block([[np.zeros((3, 3)), turn_rad * np.eye(3)], [shift_m * np.eye(3), turn_rad * about]])


def centres_of(covariances: Array) -> Array:
    """The c (N, 3) with the smallest E |v + omega x c|^2: (tr(S) - S) c = -E v x omega; zero where no turn counts."""
    of_rotation, crossed = covariances[:, :3, :3], covariances[:, 3:, :3]
    moment = np.stack([crossed[:, j, k] - crossed[:, k, j] for j, k in ((1, 2), (2, 0), (0, 1))], axis=1)
    arm = np.einsum("nii->n", of_rotation)[:, None, None] * np.eye(3) - of_rotation
    return np.asarray(-(np.linalg.pinv(arm, hermitian=True) @ moment[:, :, None])[:, :, 0])


def _moved(centre: Array) -> Array:
    """(N, 6, 6): a perturbation of a frame as one of the same frame with its origin in ``centre`` (N, 3)."""
    moved = np.tile(np.eye(6), (len(centre), 1, 1))
    moved[:, 3:, :3] = -se3.hat(centre)
    return moved


def common_slides(several: Sequence[Measurements]) -> Array:
    """The directions (6, k) of a target's axes in which none of its measurements, slid to one answer, is measured."""
    has = [each for each in map(slides_of, several) if each is not None]
    return _alike(np.concatenate([np.zeros((0, 6, 6)), *has]), sum(len(raw.A) for raw in several))


#: Slides are one direction where this share of each is in it.
ALIKE = 0.99
#: The variance of what slides of one thing, and the least that is taken for it: axes of radians and metres mix.
SLID, ROUGH = 4.0 * SLIDES, 0.1


def _alike(slides: Array, count: int, least: float = 0.5 * SLIDES) -> Array:
    """The directions (6, k) in which nearly all of ``count`` covariances have at least this variance."""
    variances, along = np.linalg.eigh(slides)
    total = np.einsum("nik,nk,njk->ij", along, (variances > least).astype(float), along)
    shares, directions = np.linalg.eigh(total / count)
    return np.asarray(directions[:, shares > ALIKE])


def with_common_slides(covariances: Array) -> Array:
    """Covariances (N, 6, 6) of one thing in its axes, in which what slides in all views is one motion of the thing.

    Each view tells where a sphere's centre is to its own noise only. A large turn about one view's centre moves those
    of the others, and so would look measured. What slides in all is one group of motions; it is taken as known in what
    each view measures. Whatever slides has the variance ``SLID``.
    """
    slides, _ = motions_of_slides(_alike(covariances, len(covariances), ROUGH))
    rest = np.linalg.svd(slides)[0][:, slides.shape[1] :]
    variances, along = np.linalg.eigh(covariances)
    informed = along * np.where(variances > ROUGH, 0.0, 1.0 / np.abs(variances))[:, None, :]
    values, turned = np.linalg.eigh(rest.T @ informed @ along.transpose(0, 2, 1) @ rest)
    axes = rest @ turned
    known = axes * np.where(values > 1.0 / ROUGH, 1.0 / np.abs(values), SLID)[:, None, :]
    result = known @ axes.transpose(0, 2, 1) + SLID * slides @ slides.T
    return np.asarray(0.5 * (result + result.transpose(0, 2, 1)))


def centre_of_slides(covariances: Array) -> Array:
    """The point (3,) about which turns slide in all covariances (N, 6, 6); the origin where none do."""
    return motions_of_slides(_alike(covariances, len(covariances), ROUGH))[1]


def motions_of_slides(slides: Array) -> tuple[Array, Array]:
    """The nearest directions (6, k) that are motions by any amount: turns about a centre (3,), shifts, no screws."""
    if not slides.size:
        return slides, np.zeros(3)
    turns, sizes, mixed = np.linalg.svd(slides[:3])
    columns, rank = slides @ mixed.T, int((sizes > 0.5).sum())
    shifts = np.linalg.svd(columns[3:, rank:], full_matrices=False)[0]
    across = np.eye(3) - shifts @ shifts.T  # a shift that slides moves the centre nowhere
    omega = (turns[:, :rank] * sizes[:rank]).T
    arms = -across @ se3.hat(omega)
    centre = np.linalg.lstsq(arms.reshape(-1, 3), (across @ columns[3:, :rank]).T.ravel(), rcond=1e-6)[0]
    found = np.zeros_like(slides)
    found[:3, :rank], found[3:, :rank], found[3:, rank:] = omega.T, (arms @ centre).T, shifts
    return np.linalg.qr(found)[0], centre


def axes_seen(raw: Measurements) -> np.ndarray:
    """(N, 6): which entries of a residual Log(B^-1 Y^-1 A X) are measured: all but those of points and planes."""
    seen = np.ones((len(raw.A), 6), dtype=bool)
    for kind in (Kind.POINT, Kind.PLANE):
        seen[raw.is_of(kind)] = ~UNSEEN[kind]
    return seen


def axes_told(raw: Measurements) -> Array:
    """(N, 2): how many directions of rotation and of translation each measurement tells."""
    told = np.full((len(raw.A), 2), 3.0)
    told[raw.is_of(Kind.POINT)], told[raw.is_of(Kind.PLANE)] = (0.0, 3.0), (2.0, 1.0)
    other = raw.is_of(Kind.DIRECTIONAL)
    if raw.covariances is not None and other.any():
        noise = raw.covariances[other]
        whole = (np.linalg.eigvalsh(noise) < SLIDES).sum(axis=1)
        told[other, 0] = (np.linalg.eigvalsh(noise[:, :3, :3]) < SLIDES).sum(axis=1)
        told[other, 1] = whole - told[other, 0]  # a turn about an arm moves the origin
    return told


def unseen_by(raw: Measurements) -> np.ndarray:
    """(6,): which directions of the target's frame none of the measurements sees."""
    if raw.kinds is None:
        return UNSEEN[Kind.POSE]
    unseen: np.ndarray = np.all([UNSEEN[Kind(kind)] for kind in np.unique(raw.kinds)], axis=0)
    return unseen
