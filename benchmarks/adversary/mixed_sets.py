"""Random sets of tags, points, planes, registrations that slide, and motions; and their cost in exact arithmetic."""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from fractions import Fraction

import numpy as np
from exact_cost import fractions
from rwhec_factors import se3

import gtsam_rwhec as rw
from gtsam_rwhec.errors import NotUniqueWarning
from gtsam_rwhec.solver.directed_pairs import DirectedPair

#: What a set may have, each with its own target; "motions" are of the sensor itself.
THINGS = ("tag", "point", "spread", "plane", "slide", "motions")
#: Standard deviations of what is measured: rad and m.
TURN_RAD, MOVE_M = 0.003, 0.001
#: The variance of what slides.
SLIDES = 900.0


@dataclass(frozen=True)
class MixedSet:
    """A problem, what is true of its frames (4, 4), and its scale."""

    problem: rw.Problem
    truth: dict[str, np.ndarray]
    scale: float


def solved(problem: rw.Problem) -> rw.Solution:
    """The solution of a set; what slides in it may leave directions free."""
    with warnings.catch_warnings(action="ignore", category=NotUniqueWarning):
        return rw.solve(problem)


def pose(rng: np.random.Generator, reach_m: float = 1.0) -> np.ndarray:
    """A random pose (4, 4)."""
    return se3.expmap(np.r_[1.5 * rng.normal(size=3), reach_m * rng.normal(size=3)][None])[0]


def mixed_set(
    seed: int, things: tuple[str, ...] | None = None, count: int = 15, scale: str | None = None, noise: float = 1.0
) -> MixedSet:
    """A random set; ``things`` are names that begin with one of ``THINGS``, at random where they are left out."""
    rng = np.random.default_rng(seed)
    if things is None:
        kinds = rng.choice(THINGS, size=rng.integers(1, 5))
        things = tuple(f"{kind}_{i}" for i, kind in enumerate(kinds))
        if all(name.startswith("motions") for name in things):
            things += ("tag_more",)
    mode = scale or str(rng.choice(["known", "shared"]))
    alpha = 1.0 if mode == "known" else float(rng.uniform(0.3, 3.0))
    problem, Y = rw.Problem(mode), pose(rng, 0.3)  # type: ignore[arg-type]
    truth = {"sensor": Y}
    for name in things:
        X = Y if name.startswith("motions") else pose(rng)
        A = np.array([pose(rng) for _ in range(count)])
        B = se3.inverse(Y)[None] @ A @ X
        _add(problem, name, A, B, alpha, noise, rng)
        if X is not Y:
            truth[name] = X
    return MixedSet(problem, truth, alpha)


def _add(
    problem: rw.Problem, name: str, A: np.ndarray, B: np.ndarray, alpha: float, noise: float, rng: np.random.Generator
) -> None:
    N, turn, move = len(A), noise * TURN_RAD, noise * MOVE_M
    t = B[:, :3, 3]
    if name.startswith("point"):
        problem.add_points(name, "sensor", A, alpha * (t + move * rng.normal(size=(N, 3))), alpha * MOVE_M)
    elif name.startswith("spread"):
        by_axis = MOVE_M * np.array([1.0, 3.0, 10.0])
        p = t + noise * by_axis * rng.normal(size=(N, 3))
        problem.add_points(name, "sensor", A, alpha * p, covariances=np.diag((alpha * by_axis) ** 2))
    elif name.startswith("plane"):
        n = B[:, :3, 2]
        p = (
            t
            + np.einsum("nij,nj->ni", B[:, :3, :2], 0.3 * rng.normal(size=(N, 2)))
            + move * rng.normal(size=(N, 1)) * n
        )
        n = n + np.cross(turn * rng.normal(size=(N, 3)), n)
        n /= np.linalg.norm(n, axis=1, keepdims=True)
        problem.add_planes(name, "sensor", A, n, alpha * p, TURN_RAD, alpha * MOVE_M)
    else:
        xi = np.concatenate([turn * rng.normal(size=(N, 3)), move * rng.normal(size=(N, 3))], axis=1)
        variances = np.repeat([TURN_RAD**2, (alpha * MOVE_M) ** 2], 3)
        if name.startswith("slide"):  # a cylinder: about its z axis, and along it
            variances[[2, 5]] = SLIDES
            xi[:, [2, 5]] = 0.1 * rng.normal(size=(N, 2))
        B = B @ se3.expmap(xi)
        B[:, :3, 3] *= alpha
        slides = name.startswith("slide")
        if name.startswith("motions"):
            problem.add_motion("sensor", A, B, covariances=np.diag(variances), directional=bool(rng.integers(2)))
        elif slides:
            problem.add(name, "sensor", A, B, covariances=np.diag(variances), directional=True)
        else:
            problem.add(name, "sensor", A, B, alpha * MOVE_M, 0.5 / TURN_RAD**2)


def exact_cost(pair: DirectedPair, X: np.ndarray, Y: np.ndarray, alpha: float) -> Fraction:
    """The cost of a pair that weighs by direction, at poses (4, 4) about the user's origin, without any rounding."""
    total, w = Fraction(0), pair.weighing
    R_X, t_X, R_Y, t_Y = (fractions(part) for T in (X, Y) for part in (T[:3, :3], T[:3, 3]))
    for i in range(pair.count):
        R_A, t_A, R_B, t_B = (fractions(part) for T in (pair.A[i], pair.B[i]) for part in (T[:3, :3], T[:3, 3]))
        E = R_A @ R_X - R_Y @ R_B
        e = Fraction(alpha) * (R_A @ t_X + t_A - t_Y) - R_Y @ t_B
        turned, moved = E @ fractions(w.turns[i]), fractions(w.axes[i]).T @ (e + E @ fractions(w.centre[i]))
        total += ((turned**2).sum(axis=0) * fractions(w.of_turns[i])).sum() + (moved**2 * fractions(w.of_axes[i])).sum()
    return total / 2
