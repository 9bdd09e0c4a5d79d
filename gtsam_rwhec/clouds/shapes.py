"""Spheres and planes in clouds: where they are, and how well that is known.

Both are found by RANSAC and fitted by least squares to the points that agree. Ranges at the edge of a thing mix it with
what is behind it, and beams that graze a surface tell little: such points are left out, and counted. Errors of points
that are neighbours may be alike; so covariances are those of patches of the surface, where these say more.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from rwhec_factors.se3 import pose
from scipy.spatial import cKDTree

from gtsam_rwhec.clouds.cloud import Cloud
from gtsam_rwhec.errors import CloudError, OptionError
from gtsam_rwhec.files.terminal_text import brief
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.geometry.real_numbers import is_between

#: Fewer points than this on a shape do not tell it.
FEWEST_POINTS = 30
#: Shapes that are tried, and points among which they are compared.
TRIES = 400
COMPARED = 2000
#: A point that is off by this many standard deviations is not of the shape.
GATE = 4.0
#: A point that is off by less than this many is of something else near its edge: a mixed pixel.
MIXED = 25.0
#: Below this cosine of the angle to the normal, a beam grazes the surface.
GRAZING = 0.3
#: The largest plane is another shape if it bends by more than this share of its width, beyond so many deviations.
BENT, CLEARLY = 0.03, 4.0
#: Neighbours by which the noise of a cloud is told, and points at which it is.
NEIGHBOURS = 16
NOISE_AT = 400
#: Patches into which a shape is divided, along each of two directions.
PATCHES = 4


@dataclass(frozen=True)
class SeenSphere:
    """A sphere in a cloud.

    Attributes
    ----------
    centre : (3,)
        In the sensor's frame, metres.
    covariance : (3, 3)
        Of the centre, m^2.
    radius_m, radius_sigma_m : float
        The radius and its standard deviation (0: it was given).
    noise_m : float
        Standard deviation of a point from the surface.
    points, mixed, grazing : int
        Points that were used; points near the edge that are off the surface, and points that the beams graze.
    """

    centre: Array
    covariance: Array
    radius_m: float
    radius_sigma_m: float
    noise_m: float
    points: int
    mixed: int
    grazing: int


@dataclass(frozen=True)
class SeenPlane:
    """A plane in a cloud: n . p = ``offset_m``, with the unit normal n towards the sensor.

    Attributes
    ----------
    T_sensor_plane : (4, 4)
        Origin in the middle of its points, z along the normal; metres.
    covariance : (3, 3)
        Of a twist's [omega_x, omega_y, v_z] in the plane's frame; rad, m.
    noise_m : float
        Standard deviation of a point from the plane.
    points, mixed : int
        Points that were used; points near it that are off it.
    """

    T_sensor_plane: Array
    covariance: Array
    noise_m: float
    points: int
    mixed: int

    @property
    def normal(self) -> Array:
        """(3,), towards the sensor."""
        return self.T_sensor_plane[:3, 2]

    @property
    def point(self) -> Array:
        """(3,), in the middle of its points."""
        return self.T_sensor_plane[:3, 3]

    @property
    def offset_m(self) -> float:
        """The sensor's distance from the plane, negative."""
        return float(self.normal @ self.point)


def find_sphere(cloud: Cloud, radius_m: float | None = None, *, noise_m: float | None = None) -> SeenSphere:
    """Find the sphere of most points in a cloud.

    Parameters
    ----------
    cloud : Cloud
    radius_m : float, optional
        Its radius. Left out: estimated.
    noise_m : float, optional
        Standard deviation of a point. Left out: as neighbours on the surface show it, which needs a dense cloud.

    Raises
    ------
    CloudError
        No sphere, or one of another radius.
    OptionError
        The radius or the noise is not positive.
    """
    where = _where(cloud)
    for name, value in (("radius_m", radius_m), ("noise_m", noise_m)):
        if value is not None and not is_between(value, 1e-7, 1e3):
            raise OptionError(f"find_sphere: {name}={brief(value)}; give a positive number of metres")
    points = cloud.points
    noise = noise_m or surface_noise(points)
    # a plane is a sphere with a radius beyond all that is seen
    largest = float(np.linalg.norm(np.ptp(points, axis=0)))
    bounds = (0.0, largest) if radius_m is None else (0.8 * radius_m, 1.2 * radius_m)
    best, off = _by_ransac(points, 4, _sphere_through, _off_sphere, noise, where, "sphere", bounds)
    centre, radius = best[:3], float(best[3]) if radius_m is None else radius_m
    ranges = np.linalg.norm(points, axis=1)
    beams = points / ranges[:, None]
    for _ in range(10):  # least squares of errors along the beams, as sensors make them
        along = beams @ centre
        inside = along**2 - centre @ centre + radius**2
        expected = along - np.sqrt(np.maximum(inside, 0.0))
        normal = (beams * expected[:, None] - centre) / radius
        cosine = np.sqrt(np.maximum(inside, 0.0)) / radius
        off = ranges - expected
        near = (np.abs(off) < GATE * _spread(off[cosine > GRAZING], noise)) & (cosine > 0.0)
        used = near & (cosine > GRAZING)
        if used.sum() < FEWEST_POINTS or not 0.0 < radius <= max(largest, radius_m or 0.0):
            known = "" if radius_m else "; give its radius_m, or a cloud without walls and tables (cloud.selected)"
            raise CloudError(
                f"{where}: no such sphere in {len(points)} points: the nearest to one has {used.sum()} points on its "
                f"side towards the sensor, away from its edge; look whether it is seen, and from near enough{known}"
            )
        J = normal[used] if radius_m is not None else np.column_stack([normal[used], np.ones(used.sum())])
        J /= cosine[used, None]
        step = -np.linalg.lstsq(J, off[used], rcond=None)[0]
        centre, radius = centre + step[:3], radius + (float(step[3]) if radius_m is None else 0.0)
        if np.abs(step).max() < 1e-4 * noise:
            break
    sigma, covariance = _covariance(J, off[used] + J @ step, normal[used], points.mean(axis=0) - centre)
    away = np.linalg.norm(points - centre, axis=1) - radius
    mixed = (np.abs(away) < MIXED * noise) & ~near
    return SeenSphere(
        centre, covariance[:3, :3], radius, 0.0 if radius_m is not None else float(np.sqrt(covariance[3, 3])), sigma,
        int(used.sum()), int(mixed.sum()), int((near & ~used).sum()),
    )  # fmt: skip


def find_plane(cloud: Cloud, *, noise_m: float | None = None) -> SeenPlane:
    """Find the plane of most points in a cloud.

    Parameters
    ----------
    cloud : Cloud
        Of the plane, or a part of a cloud (``cloud.selected``) in which it is the largest.
    noise_m : float, optional
        As in ``find_sphere``.

    Raises
    ------
    CloudError
        No plane, or it is bent, or the beams graze it.
    OptionError
        The noise is not positive.
    """
    where = _where(cloud)
    if noise_m is not None and not is_between(noise_m, 1e-7, 1e3):
        raise OptionError(f"find_plane: noise_m={brief(noise_m)}; give a positive number of metres")
    points = cloud.points
    noise = noise_m or surface_noise(points)
    _, off = _by_ransac(points, 3, plane_through, _off_plane, noise, where, "plane")
    for _ in range(10):
        used = np.abs(off) < GATE * _spread(off, noise)
        middle = points[used].mean(axis=0)
        axes = np.linalg.svd(points[used] - middle, full_matrices=False)[2]
        if abs(axes[2] @ middle) < GRAZING * np.linalg.norm(middle):
            raise CloudError(f"{where}: the beams graze the largest plane; turn it towards the sensor")
        m = _plane_by_ranges(points[used], axes[2] / (axes[2] @ middle))
        middle, normal = middle / (m @ middle), -m / np.linalg.norm(m)
        off = (points - middle) @ normal
        if np.array_equal(used, np.abs(off) < GATE * _spread(off, noise)):
            break
    first = np.cross(axes[1], normal) / np.linalg.norm(np.cross(axes[1], normal))
    R = np.stack([first, np.cross(normal, first), normal], axis=1)
    x, y = ((points[used] - middle) @ R[:, :2]).T
    J = np.stack([y, -x, np.ones(len(x))], axis=1)
    squares = np.stack([x**2, x * y, y**2], axis=1)
    squares -= J @ np.linalg.lstsq(J, squares, rcond=None)[0]
    bend = squares @ np.linalg.lstsq(squares, off[used], rcond=None)[0]
    if bend.std() > BENT * min(x.std(), y.std()) and bend.std() > CLEARLY * (off[used] - bend).std():
        raise CloudError(
            f"{where}: the largest plane is bent by {1e3 * np.ptp(bend):.2g} mm over {1e3 * np.ptp(x):.0f} mm: it is a "
            "part of a sphere or of another round thing (find_sphere, seen_object)"
        )
    sigma, covariance = _covariance(J, off[used], points[used], normal)
    mixed = (np.abs(off) < MIXED * noise) & ~used
    return SeenPlane(pose(R, middle), covariance, sigma, int(used.sum()), int(mixed.sum()))


def _plane_by_ranges(points: Array, m: Array) -> Array:
    """The plane m.x = 1 (3,) with the least squares of errors along the beams, as sensors make them.

    Distances from the plane would turn it where beams are oblique: errors shift points along it, too.
    """
    ranges = np.linalg.norm(points, axis=1)
    beams = points / ranges[:, None]
    for _ in range(3):
        expected = 1.0 / (beams @ m)
        m = m + np.linalg.lstsq(-(expected[:, None] ** 2) * beams, ranges - expected, rcond=None)[0]
    return m


def surface_noise(points: Array) -> float:
    """Standard deviation of points (N, 3) from the surfaces on which they are, as neighbours show it; metres."""
    some = np.random.default_rng(0).permutation(len(points))[:NOISE_AT]
    neighbours = cKDTree(points).query(points[some], k=min(NEIGHBOURS, len(points)))[1]
    around = points[neighbours] - points[neighbours].mean(axis=1, keepdims=True)
    least = np.linalg.eigvalsh(around.transpose(0, 2, 1) @ around)[:, 0]
    return float(max(np.sqrt(np.median(np.maximum(least, 0.0)) / max(neighbours.shape[1] - 3, 1)), 1e-6))


def _spread(off: Array, noise: float) -> float:
    """Standard deviation of points from a shape, which is more than that of neighbours where errors are smooth."""
    near = np.abs(off[np.abs(off) < MIXED * noise])
    return max(noise, 1.4826 * float(np.median(near))) if len(near) else noise


def _where(cloud: Cloud) -> str:
    return cloud.source or cloud.frame_id or "the cloud"


def _by_ransac(
    points: Array,
    few: int,
    through: Callable[[Array], Array],
    off_shape: Callable[[Array, Array], Array],
    noise: float,
    where: str,
    what: str,
    bounds: tuple[float, float] = (-np.inf, np.inf),
) -> tuple[Array, Array]:
    """The shape of most points, and how far each point is off it; from points that are neighbours, near and far."""
    words = f"{where}: no such {what} in {len(points)} points (noise {1e3 * noise:.3g} mm)"
    if len(points) < FEWEST_POINTS:
        raise CloudError(f"{words}; at least {FEWEST_POINTS} are needed")
    least, largest = bounds
    rng = np.random.default_rng(0)
    compared = points[rng.permutation(len(points))[:COMPARED]]
    tree = cKDTree(compared)
    seeds = rng.integers(len(compared), size=TRIES)
    sizes = np.geomspace(max(FEWEST_POINTS, len(compared) // 50), len(compared), 6).astype(int)
    best: Array = np.zeros(4)
    most = 0
    for number, seed in enumerate(seeds):
        about = tree.query(compared[seed], k=min(int(sizes[number % len(sizes)]), len(compared)))[1]
        shape = through(compared[rng.choice(about, few, replace=False)])
        if not np.isfinite(shape).all() or not least <= shape[3] <= largest:
            continue
        count = int((np.abs(off_shape(compared, shape)) < 2.5 * noise).sum())
        if count > most:
            best, most = shape, count
    if most * len(points) < FEWEST_POINTS * len(compared):
        raise CloudError(f"{words}; look whether it is seen, and whether the points are in metres")
    return best, off_shape(points, best)


def _sphere_through(points: Array) -> Array:
    """[centre, radius] (4,) of four points; nan where they are in one plane."""
    M = np.column_stack([2.0 * points, np.ones(4)])
    if np.linalg.cond(M) > 1e10:
        return np.full(4, np.nan)
    c = np.linalg.solve(M, (points**2).sum(axis=1))
    square = c[3] + c[:3] @ c[:3]
    return np.array([*c[:3], np.sqrt(square) if square > 0.0 else np.nan])


def _off_sphere(points: Array, sphere: Array) -> Array:
    off: Array = np.linalg.norm(points - sphere[:3], axis=1) - sphere[3]
    return off


def plane_through(points: Array) -> Array:
    """[normal, offset] (4,) of three points; nan where they are on one line."""
    normal = np.cross(points[1] - points[0], points[2] - points[0])
    length = np.linalg.norm(normal)
    return np.array([*normal, normal @ points[0]]) / length if length > 1e-12 else np.full(4, np.nan)


def _off_plane(points: Array, plane: Array) -> Array:
    off: Array = points @ plane[:3] - plane[3]
    return off


def _covariance(J: Array, off: Array, at: Array, along: Array) -> tuple[float, Array]:
    """Noise and covariance of least squares: by independent points, or by patches of the surface if these say more.

    A patch's errors are taken to be alike in any way: the scatter of the patches' sums (Liang and Zeger 1986). ``at``
    (N, 3) are places on the surface that divide it into patches, across the direction ``along``.
    """
    N, p = J.shape
    sigma = float(np.sqrt(off @ off / (N - p)))
    inverse = np.linalg.inv(J.T @ J)
    across = np.linalg.svd(along[None])[2][1:]
    places = at @ across.T
    ranks = [np.searchsorted(np.quantile(x, np.arange(1, PATCHES) / PATCHES), x) for x in places.T]
    sums = np.zeros((PATCHES**2, p))
    np.add.at(sums, ranks[0] * PATCHES + ranks[1], J * off[:, None])
    count = int((np.abs(sums).sum(axis=1) > 0.0).sum())
    independent = sigma**2 * inverse
    if count <= 2 * p:
        return sigma, independent
    by_patches = inverse @ (sums.T @ sums) @ inverse * count / (count - p)
    # along each direction in which independent points say less, the larger of both
    root = np.linalg.cholesky(independent)
    values, vectors = np.linalg.eigh(np.linalg.solve(root, np.linalg.solve(root, by_patches).T))
    wide = root @ vectors
    return sigma, (wide * np.maximum(values, 1.0)) @ wide.T
