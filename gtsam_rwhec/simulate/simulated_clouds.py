"""Clouds of things as a 3D camera on a moving carrier sees them, with the truth.

A thing is a signed distance (negative inside); rays of the camera are marched to its surface (Hart 1996, "Sphere
tracing").
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
from rwhec_factors import se3
from scipy.spatial.transform import Rotation
from scipy.special import logsumexp

from gtsam_rwhec.clouds.cloud import Cloud
from gtsam_rwhec.errors import OptionError
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.simulate.simulated_noise import Noise, Seed, perturb

Shape = Literal["bust", "cube", "box", "relief", "sphere", "cylinder", "heap"]
Distance = Callable[[Array], Array]

#: The camera is about this far from the thing's centre, m, and varies by a tenth of it.
AWAY_M = 0.35
#: Half the camera's angle of view, and its rays along each side.
HALF_ANGLE, RAYS = np.radians(15.0), 110
#: A camera looks past the centre by this, m.
ASIDE_M = 0.01
#: A surface that is steeper than this to the ray is not seen.
STEEPEST = np.radians(75.0)
#: Steps along a ray, and the distance (m) at which it has met the surface.
STEPS, MET_M = 80, 2e-6


def _box(p: Array, half: Array) -> Array:
    q = np.abs(p) - half
    return np.asarray(np.linalg.norm(np.maximum(q, 0.0), axis=-1) + np.minimum(q.max(axis=-1), 0.0))


def _balls(p: Array, centres: Array, radii: Array, smooth_m: float) -> Array:
    """Balls that melt into each other."""
    each = np.linalg.norm(p[:, None] - centres, axis=2) - radii
    return np.asarray(-smooth_m * logsumexp(-each / smooth_m, axis=1))


def thing(shape: Shape, seed: Seed) -> Distance:
    """The signed distance (m) of points (n, 3) from a thing about 12 cm large; bust, relief and heap are drawn."""
    if shape not in get_args(Shape):
        raise OptionError(f"thing: shape is {shape!r}; choose one of {', '.join(get_args(Shape))}")
    draw = np.random.default_rng(seed)
    if shape == "sphere":
        return lambda p: np.asarray(np.linalg.norm(p, axis=1) - 0.05)
    if shape == "cube":
        corner = Rotation.align_vectors([0.0, 0.0, 1.0], [1.0, 1.2, 1.4])[0].as_matrix()
        return lambda p: _box(p @ corner, np.full(3, 0.04)) - 0.001
    if shape == "box":  # no view sees two opposite sides: edges alone tell how wide it is
        return lambda p: _box(p, np.array([0.05, 0.07, 0.03]))
    if shape == "cylinder":
        return lambda p: np.asarray(np.maximum(np.hypot(p[:, 0], p[:, 1]) - 0.04, np.abs(p[:, 2]) - 0.3))
    if shape == "relief":
        places, heights = draw.uniform(-0.07, 0.07, (12, 2)), draw.uniform(-0.004, 0.004, 12)

        def relief(p: Array) -> Array:
            squares = ((p[:, None, :2] - places) ** 2).sum(axis=2)
            height = np.exp(-squares / (2.0 * 0.012**2)) @ heights
            return np.asarray(0.8 * np.maximum(_box(p, np.array([0.08, 0.06, 0.01])), p[:, 2] - 0.005 - height))

        return relief
    if shape == "bust":
        centres, radii = draw.normal(0.0, 0.03, (9, 3)), draw.uniform(0.012, 0.035, 9)
        return lambda p: _balls(p, centres, radii, 0.004)
    centres, radii = draw.uniform(-0.05, 0.05, (7, 3)), draw.uniform(0.012, 0.022, 7)
    centres[:, 2] = 0.4 * radii
    table, below = np.array([0.08, 0.08, 0.005]), np.array([0.0, 0.0, 0.005])
    return lambda p: np.asarray(np.minimum(_balls(p, centres, radii, 5e-4), _box(p + below, table)))


def seen_points(distance: Distance, T_object_camera: Array, noise_m: float, seed: Seed) -> Array:
    """Points (n, 3) of a thing in the camera's frame (z along the axis), with noise along the rays."""
    draw = np.random.default_rng(seed)
    side = np.tan(HALF_ANGLE) * np.linspace(-1.0, 1.0, RAYS)
    x, y = np.meshgrid(side, side)
    rays = np.stack([x, y, np.ones_like(x)], axis=-1).reshape(-1, 3)
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    R, start = T_object_camera[:3, :3], T_object_camera[:3, 3]
    turned = rays @ R.T
    lengths, near = np.full(len(rays), 0.3 * AWAY_M), np.full(len(rays), np.inf)
    going = np.arange(len(rays))
    for _ in range(STEPS):
        near[going] = distance(start + lengths[going, None] * turned[going])
        lengths[going] += near[going]
        going = going[(np.abs(near[going]) > MET_M) & (lengths[going] < 3.0 * AWAY_M)]
    met = np.abs(near) < 10.0 * MET_M
    points = start + lengths[met, None] * turned[met]
    step = 1e-5 * np.eye(3)
    slopes = np.column_stack([distance(points + e) - distance(points - e) for e in step])
    slopes /= np.linalg.norm(slopes, axis=1, keepdims=True)
    seen = -np.einsum("ij,ij->i", slopes, turned[met]) > np.cos(STEEPEST)
    lengths = lengths[met][seen]
    return np.asarray((lengths + draw.normal(0.0, noise_m, len(lengths)))[:, None] * rays[met][seen])


@dataclass(frozen=True, eq=False)
class SimulatedClouds:
    """Clouds of N views, A as it was measured (N, 4, 4), and the true poses (4, 4) or (N, 4, 4)."""

    clouds: list[Cloud]
    A: Array
    T_sensorcarrier_sensor: Array
    T_targetcarrier_object: Array
    T_sensor_object: Array
    distance: Distance  #: Of points (n, 3) in the thing's own frame, m


def clouds_of_thing(
    shape: Shape,
    views: int,
    seed: int,
    *,
    noise_m: float = 1e-4,
    noise_in_A: Noise | None = None,
    tilt_rad: float = 0.7,
) -> SimulatedClouds:
    """Views of a thing by a camera on a carrier, or of a thing on a carrier by a fixed camera: the same numbers.

    Parameters
    ----------
    shape : "bust", "cube", "box", "relief", "sphere", "cylinder" or "heap"
    views, seed : int
    noise_m : float
        Standard deviation of each point along its ray.
    noise_in_A : Noise, optional
        On the right of each A, which ``A`` then has.
    tilt_rad : float
        Directions of view are within this angle of the thing's z axis; the camera also turns about its own axis.
    """
    thing_draw, place, looks, points, arm = np.random.default_rng(seed).spawn(5)
    distance = thing(shape, thing_draw)
    Y = se3.pose(Rotation.random(rng=place).as_matrix(), place.uniform(-0.15, 0.15, 3))
    X = se3.pose(Rotation.random(rng=place).as_matrix(), place.uniform(-0.8, 0.8, 3))
    # Directions are even in a cone about z; the cylinder lies, so that its side is seen.
    cosine = looks.uniform(np.cos(tilt_rad), 1.0, views)
    tilts, around = np.arccos(cosine), looks.uniform(0.0, 2.0 * np.pi, views)
    turn = Rotation.from_euler("zyz", np.column_stack([around, tilts, looks.uniform(-0.8, 0.8, views) - around]))
    R = turn.as_matrix() @ np.diag([1.0, -1.0, -1.0])
    if shape == "cylinder":
        R = Rotation.from_euler("y", np.pi / 2.0).as_matrix() @ R
    away = AWAY_M * looks.uniform(0.9, 1.1, views)
    T_object_sensor = se3.pose(R, looks.normal(0.0, ASIDE_M, (views, 3)) - away[:, None] * R[:, :, 2])
    A = Y @ se3.inverse(T_object_sensor) @ se3.inverse(X)
    seen = (seen_points(distance, T, noise_m, points) for T in T_object_sensor)
    clouds = [Cloud.of(each, source=f"{shape} {k}") for k, each in enumerate(seen)]
    return SimulatedClouds(clouds, perturb(A, noise_in_A, arm), Y, X, se3.inverse(T_object_sensor), distance)
