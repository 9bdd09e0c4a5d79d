"""Measurements of one board by one camera, of which the truth is known."""

from __future__ import annotations

import numpy as np
from rwhec_factors import se3

import gtsam_rwhec as rw
from gtsam_rwhec.geometry.poses import Array

X, Y = se3.expmap(np.array([[0.3, 0.1, -0.2, 0.1, 0.0, 0.2], [1.0, 0.3, -0.5, 0.5, 0.4, 0.6]]))


def poses(chance: np.random.Generator, count: int, angle: float, length: float) -> Array:
    """Random poses (count, 4, 4), with these standard deviations about and along each axis."""
    turns = angle * chance.normal(size=(count, 3))
    return np.asarray(se3.expmap(np.hstack([turns, length * chance.normal(size=(count, 3))])))


def noisy(chance: np.random.Generator, A: Array, noise: float, X: Array = X, Y: Array = Y) -> Array:
    """B (N, 4, 4) = Y^-1 A X, with the same noise in rad and m."""
    return np.asarray(np.linalg.inv(Y) @ A @ X @ se3.expmap(noise * chance.normal(size=(len(A), 6))))


def problem_of(A: Array, B: Array, *weights: float, stamps_ns: np.ndarray | None = None) -> rw.Problem:
    """The problem of these measurements."""
    problem = rw.Problem()
    problem.add("board", "camera", A, B, *weights, stamps_ns=stamps_ns)
    return problem
