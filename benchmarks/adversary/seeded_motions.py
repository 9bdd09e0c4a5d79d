"""Rigid motions of every degeneracy in extended precision, of a generator of random numbers and nothing else.

A pose is (R, t), arrays (..., 3, 3) and (..., 3) of long doubles, so that rounding to doubles is the last and only
error of a measurement.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeAlias

import numpy as np
from rwhec_factors.se3 import pose

Long = np.longdouble
Poses: TypeAlias = tuple[np.ndarray, np.ndarray]
ARCSECOND = np.pi / 180.0 / 3600.0


def rotations(vectors: np.ndarray) -> np.ndarray:
    """Rotations (n, 3, 3) about vectors (n, 3) by their lengths, through unit quaternions."""
    vectors = np.asarray(vectors, dtype=Long)
    angle = np.sqrt((vectors**2).sum(axis=-1))
    half = angle / 2
    safe = np.where(angle > 0, angle, Long(1))
    q = np.concatenate([np.cos(half)[:, None], vectors * (np.sin(half) / safe)[:, None]], axis=1)
    return of_quaternions(q)


def of_quaternions(q: np.ndarray) -> np.ndarray:
    """Rotations (n, 3, 3) of quaternions (n, 4), w first, of any length."""
    q = np.asarray(q, dtype=Long)
    q = q / np.sqrt((q**2).sum(axis=1, keepdims=True))
    w, x, y, z = q.T
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.moveaxis(np.array(rows), 2, 0)


def random_rotations(rng: np.random.Generator, n: int) -> np.ndarray:
    return of_quaternions(rng.standard_normal((n, 4)))


def random_pose(rng: np.random.Generator, size_m: float = 1.0) -> Poses:
    return random_rotations(rng, 1)[0], (size_m * rng.standard_normal(3)).astype(Long)


def composed(a: Poses, b: Poses) -> Poses:
    return a[0] @ b[0], (a[0] @ b[1][..., None])[..., 0] + a[1]


def inverted(a: Poses) -> Poses:
    R = np.swapaxes(a[0], -1, -2)
    return R, -(R @ a[1][..., None])[..., 0]


def unit(rng: np.random.Generator) -> np.ndarray:
    v = rng.standard_normal(3)
    return v / np.linalg.norm(v)


def _excited(rng: np.random.Generator, n: int) -> Poses:
    return random_rotations(rng, n), rng.standard_normal((n, 3))


def _one_axis(rng: np.random.Generator, n: int) -> Poses:
    axis = unit(rng) if rng.random() < 0.6 else np.eye(3)[rng.integers(3)]
    return rotations(rng.uniform(-3, 3, (n, 1)) * axis), rng.standard_normal((n, 3))


def _turntable(rng: np.random.Generator, n: int) -> Poses:
    R, t = _one_axis(rng, n)
    return R, np.broadcast_to(t[:1], t.shape)


def _planar(rng: np.random.Generator, n: int) -> Poses:
    angles = rng.uniform(-3, 3, (n, 1)) * rng.choice([1.0, 0.1])
    t = rng.standard_normal((n, 3)) * (1.0, 1.0, 0.0) * rng.choice([1.0, 10.0])
    return rotations(angles * (0.0, 0.0, 1.0)), t


def _pure_rotation(rng: np.random.Generator, n: int) -> Poses:
    return random_rotations(rng, n), np.zeros((n, 3))


def _no_rotation(rng: np.random.Generator, n: int) -> Poses:
    return np.broadcast_to(np.eye(3), (n, 3, 3)), rng.standard_normal((n, 3))


def _small_rotation(rng: np.random.Generator, n: int) -> Poses:
    size = ARCSECOND * 10 ** rng.uniform(0, 4)
    t = rng.standard_normal((n, 3)) * rng.choice([1.0, 0.01])
    return rotations(size * rng.standard_normal((n, 3))), t


def _half_turns(rng: np.random.Generator, n: int) -> Poses:
    axes = rng.standard_normal((n, 3))
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    off = rng.choice([0.0, 1e-12, 1e-8, 1e-4]) * rng.standard_normal((n, 1))
    return rotations((np.pi - off) * axes), rng.standard_normal((n, 3))


def _still(rng: np.random.Generator, n: int) -> Poses:
    jitter = rng.choice([0.0, 1e-9, 1e-6, 1e-3])
    return rotations(jitter * rng.standard_normal((n, 3))), jitter * rng.standard_normal((n, 3))


def _two_stations(rng: np.random.Generator, n: int) -> Poses:
    R, t = _excited(rng, 2)
    which = rng.integers(0, 2, n)
    return R[which], t[which]


def _nearly_one_axis(rng: np.random.Generator, n: int) -> Poses:
    axis, tilt = unit(rng), 10 ** rng.uniform(-8, -1)
    R = rotations(rng.uniform(-3, 3, (n, 1)) * axis + tilt * rng.standard_normal((n, 3)))
    return R, rng.standard_normal((n, 3))


def quarter_turns(rng: np.random.Generator, n: int) -> np.ndarray:
    """Rotations of a cube (n, 3, 3): their entries are whole numbers."""
    result = np.zeros((n, 3, 3))
    for R in result:
        R[range(3), rng.permutation(3)] = rng.choice([-1.0, 1.0], 3)
        R *= np.linalg.det(R).round()
    return result


def _quarter_turns(rng: np.random.Generator, n: int) -> Poses:
    return quarter_turns(rng, n), rng.integers(-2, 3, (n, 3)).astype(float)


def about_z(rng: np.random.Generator) -> np.ndarray:
    return rotations(rng.uniform(-3, 3, (1, 1)) * (0.0, 0.0, 1.0))[0]


#: The motion of the sensor's carrier, in coordinates that the generator hides behind a pose on each side.
MOTIONS: dict[str, Callable[[np.random.Generator, int], Poses]] = {
    "excited": _excited,
    "one axis": _one_axis,
    "nearly one axis": _nearly_one_axis,
    "turntable": _turntable,
    "planar": _planar,
    "pure rotation": _pure_rotation,
    "no rotation": _no_rotation,
    "small rotation": _small_rotation,
    "half turns": _half_turns,
    "still": _still,
    "two stations": _two_stations,
    "mirror twins": _planar,
    "quarter turns": _quarter_turns,
}


def doubles(poses: Poses) -> np.ndarray:
    """Matrices (n, 4, 4) of doubles: each entry is the nearest one."""
    R, t = poses
    return pose(R, t)
