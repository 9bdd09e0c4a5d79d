"""A plain rectangular board in the cloud of a LiDAR of few beams: where it is, its pose, and how well that is known.

The plane is told by the points on the board; in it, the rectangle by which beams hit the board and which pass beside
it. So a horizontal edge between two beams is known to the gap between these, and the covariance says so.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from rwhec_factors.se3 import pose

from gtsam_rwhec.clouds.beams import Beams, Segments, beams_of
from gtsam_rwhec.clouds.board_rectangle import (
    HIT,
    MISS,
    MIXED,
    UNKNOWN,
    Rays,
    Rectangle,
    board_turns,
    inside_m,
    rectangle_by,
)
from gtsam_rwhec.clouds.cloud import Cloud
from gtsam_rwhec.clouds.shapes import plane_through
from gtsam_rwhec.errors import CloudError, OptionError
from gtsam_rwhec.files.terminal_text import brief
from gtsam_rwhec.geometry.poses import Array, PoseLike, one_transform
from gtsam_rwhec.geometry.real_numbers import is_between

#: A range that is off by this many standard deviations is not of the board's plane.
GATE = 4.0
#: Fewer points or beams on a board do not tell its plane.
FEWEST_POINTS = 30
FEWEST_BEAMS = 3
#: Below this cosine of the angle to a plane's normal a beam grazes it, and its range tells little.
GRAZING = 0.25


@dataclass(frozen=True)
class LidarBoardOptions:
    """What is known of a LiDAR; the defaults are those of common ones with 16 beams."""

    #: Standard deviation of a range, metres.
    noise_m: float = 0.015
    #: Standard deviation of what each beam measures too far, always; metres. Many places tell more (``seen_boards``).
    beam_bias_m: float = 0.005
    #: Full angle of a beam, radians.
    divergence_rad: float = 0.003

    def __post_init__(self) -> None:
        for name in ("noise_m", "beam_bias_m", "divergence_rad"):
            if not is_between(getattr(self, name), 1e-6, 1.0):
                raise OptionError(
                    f"LidarBoardOptions.{name}={brief(getattr(self, name))}; give a number from 1e-6 to 1 (metres, rad)"
                )


@dataclass(frozen=True)
class BeamBiases:
    """What each beam of a LiDAR measures too far: ``bias_m`` (beams,) by ``rings``, and its covariance."""

    rings: np.ndarray
    bias_m: Array
    covariance: Array


@dataclass(frozen=True)
class LidarBoard:
    """A board in a cloud.

    Attributes
    ----------
    T_sensor_board : (4, 4)
        Origin in the board's middle, x along its width, y along its height, z towards the sensor; metres. A rectangle
        looks the same after half a turn, a square after a quarter.
    covariance : (6, 6)
        Of the right perturbation [omega, v]; rad, m.
    points : int
        On the board, inside of its edges.
    mixed : int
        Points at its edges whose pulse hit the board and what is behind: left out.
    noise_m : float
        Standard deviation of a range about the plane, beam by beam.
    span_s : float or None
        The time that passed between the board's first and last point, if the cloud tells times.
    moments : BeamMoments
        What the points tell of each beam's bias.
    """

    T_sensor_board: Array
    covariance: Array
    points: int
    mixed: int
    noise_m: float
    span_s: float | None
    moments: BeamMoments


class BeamMoments(NamedTuple):
    """What a board's points tell of the beams' biases: information (beams, beams) and its product with the biases."""

    rings: np.ndarray
    information: Array
    vector: Array


def find_board(
    cloud: Cloud,
    size_m: tuple[float, float],
    *,
    near: PoseLike | None = None,
    within_m: float = 0.5,
    options: LidarBoardOptions | None = None,
    biases: BeamBiases | None = None,
) -> LidarBoard:
    """Find a board of a known size in the cloud of a LiDAR that spins about its z axis.

    Parameters
    ----------
    cloud : Cloud
        With ``rings``, or with beams that are apart in elevation.
    size_m : (width, height)
        The board's sides, metres.
    near : pose, optional
        T_sensor_board, roughly. Left out: the one flat piece of that size in the cloud.
    within_m : float
        The board's middle is at most so far from ``near``.
    options : LidarBoardOptions, optional
    biases : BeamBiases, optional
        Of many places (``seen_boards``). Left out: unknown, with the standard deviation in the options.

    Raises
    ------
    CloudError
        There is no such board, or more than one, or it is hit by too few beams.
    OptionError
        A size is not positive.
    """
    options = options or LidarBoardOptions()
    where = cloud.source or cloud.frame_id or "the cloud"
    if len(size_m) != 2 or not all(is_between(side, 0.01, 100.0) for side in size_m):
        raise OptionError(f"size_m={brief(size_m)}; give the board's width and height, each 0.01 to 100 metres")
    beams = beams_of(cloud, where)
    if biases is not None:
        beams = beams.corrected(biases.rings, biases.bias_m)
    start = None if near is None else one_transform(near, "near (T_sensor_board)")
    found: list[LidarBoard] = []
    reasons: list[str] = []
    for candidate in _candidates(beams, size_m, start, within_m, options):
        board = _fitted(beams, candidate, size_m, options, biases)
        if isinstance(board, str):
            reasons.append(board)
        elif start is None or np.linalg.norm(board.T_sensor_board[:3, 3] - start[:3, 3]) <= within_m:
            found.append(board)
    size = f"{size_m[0]:g} x {size_m[1]:g} m"
    if not found:
        why = f" ({'; '.join(sorted(set(reasons))[:3])})" if reasons else ""
        place = "" if start is None else f" within {within_m:g} m of {np.round(start[:3, 3], 2)}"
        raise CloudError(
            f"{where}: no board of {size}{place}{why}; hold it away from walls, people and the floor, so that at least "
            f"{FEWEST_BEAMS} beams hit it, or say where it is (near)"
        )
    if len(found) > 1:
        places = ", ".join(str(np.round(board.T_sensor_board[:3, 3], 2)) for board in found)
        raise CloudError(f"{where}: {len(found)} flat pieces have the board's size ({size}), at {places}; give near")
    return found[0] if start is None else _turned_to(found[0], start, size_m)


def turned_like(T: Array, covariance: Array, like: Array, size_m: tuple[float, float]) -> tuple[Array, Array]:
    """A board's pose (4, 4) and covariance (6, 6), turned to be as near to another rotation (3, 3) as it can be."""
    turn = max(board_turns(size_m), key=lambda R: float(np.trace(like.T @ T[:3, :3] @ R)))
    both = np.kron(np.eye(2), turn)
    return T @ pose(turn, np.zeros(3)), both.T @ covariance @ both


def _turned_to(board: LidarBoard, like: Array, size_m: tuple[float, float]) -> LidarBoard:
    T, covariance = turned_like(board.T_sensor_board, board.covariance, like[:3, :3], size_m)
    return LidarBoard(T, covariance, *(getattr(board, name) for name in LidarBoard.__match_args__[2:]))


# -- where it may be ---------------------------------------------------------------------------------------------------


def _candidates(
    beams: Beams, size_m: tuple[float, float], start: Array | None, within_m: float, options: LidarBoardOptions
) -> Iterator[np.ndarray]:
    """Points (indices) that may be a board's: those near a pose, or pieces that stand before what is behind them."""
    diagonal = float(np.hypot(*size_m))
    if start is not None:
        away = np.linalg.norm(beams.points - start[:3, 3], axis=1)
        yield np.flatnonzero(away < within_m + 0.5 * diagonal)
        return
    segments = Segments.of(beams, max(0.1, 6.0 * options.noise_m))
    yield from segments.pieces(longest_m=1.1 * diagonal, shortest_m=0.1 * min(size_m))


class _Flat(NamedTuple):
    """A plane n . p = offset, n towards the sensor."""

    normal: Array
    offset: float

    def ranges(self, directions: Array) -> Array:
        """Where rays (N, 3) from the sensor meet the plane; infinite where they graze it or do not."""
        cosines = directions @ self.normal
        return np.where(cosines < -0.5 * GRAZING, self.offset / np.minimum(cosines, -1e-9), np.inf)


def _largest_plane(points: Array, noise_m: float) -> tuple[_Flat, np.ndarray] | None:
    """The plane of most points by RANSAC, and which are on it."""
    rng = np.random.default_rng(0)
    tried = [plane_through(points[rng.choice(len(points), 3, replace=False)]) for _ in range(200)]
    counts = [int((np.abs(points @ plane[:3] - plane[3]) < 2.5 * noise_m).sum()) for plane in tried]
    if max(counts) < FEWEST_POINTS:
        return None
    best = tried[int(np.argmax(counts))]
    normal, offset = best[:3], float(best[3])
    for _ in range(3):
        on = np.abs(points @ normal - offset) < 3.0 * noise_m
        middle = points[on].mean(axis=0)
        normal = np.linalg.svd(points[on] - middle, full_matrices=False)[2][2]
        offset = float(normal @ middle)
    if offset > 0.0:  # towards the sensor, which is at the origin
        normal, offset = -normal, -offset
    return _Flat(normal, offset), on


# -- the board there ---------------------------------------------------------------------------------------------------


def _fitted(
    beams: Beams,
    candidate: np.ndarray,
    size_m: tuple[float, float],
    options: LidarBoardOptions,
    biases: BeamBiases | None,
) -> LidarBoard | str:
    """The board whose points are among the candidates, or why there is none."""
    few = f"a piece with fewer than {FEWEST_POINTS} points on a plane, by {FEWEST_BEAMS} beams"
    found = _largest_plane(beams.points[candidate], options.noise_m) if len(candidate) >= FEWEST_POINTS else None
    if found is None:
        return few
    flat, on = found
    rough = candidate[on]
    middle = beams.points[rough].mean(axis=0)
    if flat.normal @ middle > -GRAZING * np.linalg.norm(middle):
        return "a piece that the beams graze"
    if len(np.unique(beams.rings[rough])) < FEWEST_BEAMS:
        return few
    rectangle: Rectangle | None = None
    while True:  # the plane of all points, then of those inside of the edges
        x = np.cross([0.0, 0.0, 1.0], flat.normal)
        x = x / np.linalg.norm(x) if np.linalg.norm(x) > 1e-3 else np.array([0.0, 1.0, 0.0])
        axes = np.stack([x, np.cross(flat.normal, x)], axis=1)  # (3, 2), in the plane
        rays = _rays(beams, flat, middle, 0.75 * float(np.hypot(*size_m)), options)
        told = rectangle_by(
            rays, axes, np.array(size_m), options.divergence_rad, float(np.linalg.norm(middle)), rectangle
        )
        if isinstance(told, str):
            return told
        plane = _plane_of(beams, flat, axes, rays, told, size_m, options, biases)
        if plane is None:
            return few
        if rectangle is not None:
            return _board(beams, plane, axes, rays, told)
        rectangle = told
        flat, middle = plane.flat, plane.flat.offset * flat.normal + axes @ rectangle.mean[:2]


def _rays(beams: Beams, flat: _Flat, middle: Array, radius_m: float, options: LidarBoardOptions) -> Rays:
    lattice = beams.lattice(middle, radius_m)
    expected = flat.ranges(lattice.directions)
    gate = max(GATE * options.noise_m, 0.03)
    with np.errstate(invalid="ignore"):
        behind = np.where(lattice.point < 0, np.inf, lattice.ranges - expected)
    hit = np.where(np.abs(behind) <= gate, HIT, np.where(behind > gate, MISS, UNKNOWN))
    # A point behind the plane, next to one on it, and apart from its other neighbour in depth: a mixed pixel.
    mixed = np.zeros(len(hit), dtype=bool)
    same = lattice.rings[1:] == lattice.rings[:-1]
    for inner, outer in ((slice(None, -2), slice(2, None)), (slice(2, None), slice(None, -2))):
        with np.errstate(invalid="ignore"):
            apart = np.abs(lattice.ranges[1:-1] - lattice.ranges[outer]) > gate
        mixed[1:-1] |= (
            same[1:] & same[:-1] & (hit[inner] == HIT) & (hit[1:-1] == MISS) & apart & (lattice.point[1:-1] >= 0)
        )
    hit[mixed] = MIXED
    at = expected[:, None] * lattice.directions
    kept = np.isfinite(expected)
    kept[kept] = np.linalg.norm(at[kept] - middle, axis=1) < radius_m
    return Rays(at[kept], hit[kept], lattice.point[kept], int(mixed[kept].sum()))


class _PlaneOf(NamedTuple):
    """The plane of a board's points, with the covariance (3, 3) of [omega_x, omega_y, v_z] at the board's middle."""

    flat: _Flat
    covariance: Array
    noise_m: float
    inner: np.ndarray  #: points of the cloud
    moments: BeamMoments


def _plane_of(
    beams: Beams,
    flat: _Flat,
    axes: Array,
    rays: Rays,
    rectangle: Rectangle,
    size_m: tuple[float, float],
    options: LidarBoardOptions,
    biases: BeamBiases | None,
) -> _PlaneOf | None:
    """The plane by generalised least squares: ranges with white noise, and a bias of each beam."""
    margin = options.divergence_rad * np.linalg.norm(rays.at, axis=1) + 0.005
    inner = (rays.hit == HIT) & (inside_m(rays.at @ axes, rectangle.mean[None], size_m)[0] > margin)
    index, at = rays.point[inner], rays.at[inner]
    if len(index) < FEWEST_POINTS:
        return None
    c, s = np.cos(rectangle.mean[2]), np.sin(rectangle.mean[2])
    own = axes @ np.array([[c, -s], [s, c]])  # the board's x and y
    middle = flat.offset * flat.normal + axes @ rectangle.mean[:2]
    x, y = ((at - middle) @ own).T
    ranges, directions = beams.ranges[index], beams.directions[index]
    rings, ring = np.unique(beams.rings[index], return_inverse=True)
    if len(rings) < FEWEST_BEAMS:
        return None
    # A twist of the board moves its surface by v_z + omega_x y - omega_y x along the normal.
    J = np.stack([y, -x, np.ones(len(x))], axis=1) / (directions @ flat.normal)[:, None]
    e = ranges - np.linalg.norm(at, axis=1)
    Z = np.eye(len(rings))[ring]
    whole = np.concatenate([J, Z], axis=1)
    left = e - whole @ np.linalg.lstsq(whole, e, rcond=None)[0]
    # the spread alone: a few stray points in the gate do not make it larger
    noise = max(float(1.4826 * np.median(np.abs(left))) * np.sqrt(len(e) / (len(e) - len(rings))), 1e-4)
    if biases is None:
        P = np.eye(len(rings)) * options.beam_bias_m**2
    else:
        at_rings = np.searchsorted(biases.rings, rings)
        P = biases.covariance[np.ix_(at_rings, at_rings)] + 1e-10 * np.eye(len(rings))
    count = Z.sum(axis=0)
    inner_matrix = np.linalg.inv(noise**2 * np.linalg.inv(P) + np.diag(count))
    JZ, eZ = Z.T @ J, Z.T @ e
    H = (J.T @ J - JZ.T @ inner_matrix @ JZ) / noise**2
    g = (J.T @ e - JZ.T @ inner_matrix @ eZ) / noise**2
    covariance = np.linalg.inv(H)
    step = covariance @ g
    turn = own @ np.array([step[1], -step[0]])  # omega x n
    normal = flat.normal + turn
    normal /= np.linalg.norm(normal)
    moved = middle + step[2] * flat.normal
    by_plane = np.linalg.solve(J.T @ J, JZ.T)
    information = (np.diag(count) - JZ @ by_plane) / noise**2
    vector = (eZ - by_plane.T @ (J.T @ e)) / noise**2
    return _PlaneOf(
        _Flat(normal, float(normal @ moved)), covariance, noise, index, BeamMoments(rings, information, vector)
    )


def _board(beams: Beams, plane: _PlaneOf, axes: Array, rays: Rays, rectangle: Rectangle) -> LidarBoard:
    """The board's pose and covariance, from its plane and its rectangle."""
    u, v, angle = rectangle.mean[:3]
    normal = plane.flat.normal
    c, s = np.cos(angle), np.sin(angle)
    x = axes @ np.array([c, s])
    x = x - (x @ normal) * normal
    x /= np.linalg.norm(x)
    R = np.stack([x, np.cross(normal, x), normal], axis=1)
    # The middle is where its ray meets the plane, which was fitted after the rectangle.
    before = np.cross(axes[:, 0], axes[:, 1])
    ray = axes @ np.array([u, v]) + before * (rays.at[0] @ before)
    middle = ray * (plane.flat.offset / (normal @ ray))
    covariance = np.zeros((6, 6))
    to_own = np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
    flat = np.ix_([3, 4, 2], [3, 4, 2])
    covariance[flat] = to_own @ rectangle.covariance[:3, :3] @ to_own.T
    # Where the plane is nearer or farther, the edges' rays meet it elsewhere: v_x and v_y follow v_z along the ray.
    along = R.T @ ray
    by_plane = np.zeros((6, 3))
    by_plane[0, 0] = by_plane[1, 1] = by_plane[5, 2] = 1.0
    by_plane[3:5, 2] = along[:2] / along[2]
    covariance += by_plane @ plane.covariance @ by_plane.T
    times = beams.times_s
    span = None if times is None else float(np.ptp(times[plane.inner]))
    return LidarBoard(pose(R, middle), covariance, len(plane.inner), rays.mixed, plane.noise_m, span, plane.moments)
