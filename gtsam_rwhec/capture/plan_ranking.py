"""Candidates in the order in which they are best measured, and what each leaves: greedy, with rank updates.

With the information L so far a candidate adds W'W (`plan_information`). While a frame's pose has a direction that the
measurements leave free, the candidate with the largest log det(I + W L^-1 W') comes next. This gain is monotone and
submodular, so what greedy choice gathers of it is at least 1 - 1/e of what as many candidates can (Nemhauser, Wolsey,
Fisher 1978); `bound_of` bounds that share for the choice at hand, mostly far above. Once all is determined, the
candidate comes next that leaves the least variance of the task, which is neither submodular nor bounded so.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from gtsam_rwhec.calibration.point_uncertainty import ball_radius, jacobian_of_point
from gtsam_rwhec.capture.plan_cell import Cell
from gtsam_rwhec.geometry.poses import Array

#: A direction of a frame is free while its deviation is above this share of what it was by a rough guess.
FREE = 0.3


@dataclass(frozen=True, eq=False)
class Task:
    """The points whose deviations count: one before each sensor that counts."""

    sensors: tuple[str, ...]
    distances_m: tuple[float, ...]
    rows: Array  #: (s, 3, d): the points' derivatives by all unknowns
    level: float

    @staticmethod
    def of(cell: Cell, sensors: Sequence[str], distances_m: Sequence[float], level: float) -> Task:
        """The points on the sensors' axes at these distances, on their carrier."""
        rows = np.zeros((len(sensors), 3, cell.dimension))
        for i, (name, distance) in enumerate(zip(sensors, distances_m, strict=True)):
            if name in cell.slots:
                rows[i, :, cell.slots[name]] = jacobian_of_point(np.eye(3), np.array([0.0, 0.0, distance]))
        return Task(tuple(sensors), tuple(distances_m), rows, level)

    def variances(self, covariance: Array) -> Array:
        """The variances (s, 3) along the principal axes of each point's error, by the covariance (d, d)."""
        return np.linalg.eigvalsh(self.rows @ covariance @ self.rows.transpose(0, 2, 1))

    def radius_mm(self, cell: Cell, covariance: Array, degrees_of_freedom: float) -> tuple[float, str]:
        """The worst point's distance from its true place at the level, mm, and its sensor; infinite if it is free."""
        free = free_frames(cell, covariance)
        radii = [
            np.inf if name in free else 1e3 * ball_radius(np.maximum(of, 0.0), self.level, degrees_of_freedom)
            for name, of in zip(self.sensors, self.variances(covariance + cell.floor), strict=True)
        ]
        worst = int(np.argmax(radii))
        return float(radii[worst]), self.sensors[worst]


def free_frames(cell: Cell, covariance: Array) -> tuple[str, ...]:
    """The frames whose poses have a direction that is hardly better known than by a rough guess."""
    root = np.sqrt(cell.rough)
    loose = covariance * root[:, None] * root
    frames = [name for name in (*cell.Y, *cell.X) if name in cell.slots]
    return tuple(name for name in frames if np.linalg.eigvalsh(loose[cell.slots[name], cell.slots[name]])[-1] > FREE**2)


@dataclass(frozen=True, eq=False)
class Ranking:
    """The order, and after each of the chosen candidates: what it added, and what is left."""

    order: tuple[int, ...]
    nats: tuple[float, ...]
    radii_mm: tuple[float, ...]
    information: Array  #: (d, d): of the measurements so far, the guesses, and all that were chosen
    degrees_of_freedom: float


def ranked(
    cell: Cell,
    task: Task,
    W: Array,
    number_seen: np.ndarray,
    count: int,
    *,
    certainty: Array | float = 1.0,
    first: int | None = None,
) -> Ranking:
    """The ``count`` best candidates, if there are as many, the best first.

    ``W`` (N, r, d) has the rows of each candidate, ``number_seen`` (N,) how many targets are seen at each, and
    ``certainty`` (N,) how probably: while frames are known roughly, a likely gain counts more than a large one.
    ``first`` is the candidate that comes first all the same.
    """
    covariance = np.linalg.inv(cell.known + np.diag(cell.rough))
    open_ = np.ones(len(W), dtype=bool)
    order, nats, radii, freedom = [], [], [], cell.degrees_of_freedom
    for step in range(min(count, len(W))):
        T, L, gain = _gains(W, covariance)
        if first is not None and step == 0:
            chosen = first
        elif free_frames(cell, covariance):
            chosen = int(np.argmax(np.where(open_, certainty * gain, -np.inf)))
        else:
            chosen = int(np.argmin(np.where(open_, _left(cell, task, T, L, covariance), np.inf)))
        open_[chosen] = False
        root = np.linalg.solve(L[chosen], T[chosen])
        covariance = covariance - root.T @ root
        freedom += 3.0 * float(number_seen[chosen])
        order.append(chosen)
        nats.append(float(gain[chosen]))
        radii.append(task.radius_mm(cell, covariance, freedom)[0])
    added = np.einsum("nij,nik->jk", W[order], W[order])
    return Ranking(tuple(order), tuple(nats), tuple(radii), cell.known + np.diag(cell.rough) + added, freedom)


def _gains(W: Array, covariance: Array) -> tuple[Array, Array, Array]:
    """W S (N, r, d), the Cholesky factors of I + W S W' (N, r, r), and the logarithms of their determinants (N,)."""
    T = W @ covariance
    L = np.linalg.cholesky(np.eye(W.shape[1]) + T @ W.transpose(0, 2, 1))
    return T, L, 2.0 * np.log(np.einsum("nii->ni", L)).sum(axis=1)


def _left(cell: Cell, task: Task, T: Array, L: Array, covariance: Array) -> Array:
    """The variance of the worst direction of the worst point after each candidate, (N,)."""
    s, d = len(task.rows), cell.dimension
    rows = task.rows.reshape(3 * s, d)
    root = np.linalg.solve(L, T @ rows.T).reshape(len(T), -1, s, 3)
    before = np.einsum("sij,jk,slk->sil", task.rows, covariance + cell.floor, task.rows)
    after = before - np.einsum("nrsi,nrsj->nsij", root, root)
    return np.asarray(np.linalg.eigvalsh(after)[:, :, -1].max(axis=1, initial=0.0))


def bound_of(W: Array, ranking: Ranking) -> float:
    """The least share of the information (log det) that any as many candidates add, which those that were chosen add.

    What others add to the chosen ones is at most the sum of what each adds alone (Minoux 1978).
    """
    gathered, count = sum(ranking.nats), len(ranking.order)
    more = _gains(W, np.linalg.inv(ranking.information))[2]
    more[list(ranking.order)] = 0.0
    return gathered / max(gathered + float(np.sort(more)[-count:].sum()), 1e-300)
