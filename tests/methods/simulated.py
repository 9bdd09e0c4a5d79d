"""Motions of two rigidly joined frames, with the DQ paper's noise (eq. 38): for the tests of AX = XB."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from rwhec_factors.se3 import pose
from scipy.spatial.transform import Rotation

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Simulated:
    C: Array
    H: Array
    X: Array


def poses(rotvecs: Array, translations: Array) -> Array:
    return pose(Rotation.from_rotvec(rotvecs).as_matrix(), translations)


def perturbed(T: Array, sigma_rad: float, sigma_m: float, rng: np.random.Generator) -> Array:
    axes = rng.normal(size=(len(T), 3))
    axes /= np.linalg.norm(axes, axis=1)[:, None]
    return T @ poses(axes * rng.normal(0.0, sigma_rad, (len(T), 1)), rng.normal(0.0, sigma_m, (len(T), 3)))


def pair(H: Array, rng: np.random.Generator, sigma_rad: float, sigma_m: float, X: Array | None = None) -> Simulated:
    """Both frames' motions of exact H, each with noise."""
    if X is None:
        X = poses(Rotation.random(1, random_state=rng).as_rotvec(), rng.normal(size=(1, 3)))[0]
    C = X @ H @ np.linalg.inv(X)
    return Simulated(perturbed(C, sigma_rad, sigma_m, rng), perturbed(H, sigma_rad, sigma_m, rng), X)


def hand_held(
    count: int, seed: int, sigma_rad: float = 0.01, sigma_m: float = 0.01, largest_rad: float = 3.0
) -> Simulated:
    rng = np.random.default_rng(seed)
    axes = rng.normal(size=(count, 3))
    axes /= np.linalg.norm(axes, axis=1)[:, None]
    return pair(
        poses(axes * rng.uniform(0.0, largest_rad, (count, 1)), rng.uniform(-1, 1, (count, 3))), rng, sigma_rad, sigma_m
    )


def planar(
    count: int, seed: int, sigma_rad: float = 0.01, sigma_m: float = 0.01, jitter_rad: float = 0.02
) -> Simulated:
    """Turns about z and moves in its plane, with a little of everything else."""
    rng = np.random.default_rng(seed)
    rotvecs = rng.normal(0.0, jitter_rad, (count, 3)) + np.outer(rng.uniform(-0.5, 0.5, count), [0, 0, 1.0])
    translations = rng.uniform(-0.5, 0.5, (count, 3)) * [1.0, 1.0, jitter_rad]
    return pair(poses(rotvecs, translations), rng, sigma_rad, sigma_m)


def distance(X: object, truth: Array) -> tuple[float, float]:
    """Angle (rad) and length (m) between a gtsam.Pose3 and a (4, 4) array."""
    T = X.matrix()  # type: ignore[attr-defined]
    return Rotation.from_matrix(T[:3, :3].T @ truth[:3, :3]).magnitude(), float(np.linalg.norm(T[:3, 3] - truth[:3, 3]))
