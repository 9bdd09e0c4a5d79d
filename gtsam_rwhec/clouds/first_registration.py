"""The start without a guess: where the sensor is on its carrier, so that the clouds of many poses show one thing.

Every pose of a sensor on its carrier predicts how each view lies to another: T_i_j = Y^-1 A_i A_j^-1 Y. Starts are
rotations that are evenly spread over all (Alexa 2022, "Super-Fibonacci spirals"). Each is refined by what all views
tell at once (points to planes), from a wide gate to a narrow one, and few are kept from gate to gate.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from rwhec_factors import se3
from scipy.spatial.transform import Rotation

from gtsam_rwhec.clouds.point_to_plane import across
from gtsam_rwhec.clouds.surfaces import Features, Surface, size_of
from gtsam_rwhec.geometry.poses import Array

#: Rotations of the sensor on its carrier that are tried: neighbours are 40 degrees apart.
ROTATIONS = 120
#: Pairs of views by which starts are compared.
PAIRS = 12
#: Relative rotations beyond this, rad, are used if there are no others: views from far apart hardly overlap.
WIDE = np.radians(70.0)
#: Points of a surface that are moved, and those to which they are moved in the early stages.
MOVED, COARSE = 64, 500
#: (gate as a share of the thing's size, steps, starts that are kept)
STAGES = ((0.8, 4, 24), (0.4, 6, 10), (0.15, 8, 6))
#: Gate (in spacings) and steps of the last stage.
LAST = (4.0, 8)
#: Starts that differ by less than these (rad, share of the size) are one.
SAME = (0.02, 0.05)
#: Views show one thing if points are closer to other views than this, as shares of the gate's square: all of them, or
#: those within the gate (wrong poses have 0.18 and more, right ones less than 0.1, however little the views overlap; a
#: LiDAR's in rooms, and a thing before an endless wall, up to 0.14).
MISFIT, CLOSE = 0.45, 0.15
#: A start is worse than the best if it is so by this many of the deviations of pairs.
CLEARLY = 4.0


@dataclass(frozen=True)
class Start:
    """A pose T_sensorcarrier_sensor (4, 4) that may explain the clouds.

    ``misfits`` (P,) are mean squared distances of points from another view, as shares of the gate's square (1: they
    nowhere touch), by pair; ``near`` (P,) the shares of the points that have the other view within the gate.
    """

    T_sensorcarrier_sensor: Array
    misfits: Array
    near: Array

    @property
    def misfit(self) -> float:
        """The mean over all points."""
        return float(self.misfits.mean())

    @property
    def closeness(self) -> float:
        """The mean over those points that are near: how well surfaces lie on each other where they overlap."""
        near = float(self.near.mean())
        return (self.misfit - (1.0 - near)) / near if near else 1.0

    @property
    def explains(self) -> bool:
        """Whether the views show one thing at this pose."""
        return self.misfit < MISFIT or self.closeness < CLOSE


def rotations(count: int) -> Array:
    """Rotations (count, 3, 3) that are evenly spread."""
    s = np.arange(count) + 0.5
    r, R = np.sqrt(s / count), np.sqrt(1.0 - s / count)
    a, b = 2.0 * np.pi * s / np.sqrt(2.0), 2.0 * np.pi * s / 1.533751168755204288118041
    rows = np.column_stack([r * np.sin(a), r * np.cos(a), R * np.sin(b), R * np.cos(b)])
    return np.asarray(Rotation.from_quat(rows).as_matrix())


@dataclass(frozen=True)
class _Pairs:
    """Directed pairs of views: points (P, m, 3) of one, the surface of the other, and A_other A_one^-1 (P, 4, 4)."""

    points: Array
    others: Sequence[int]
    motions: Array


class _Search:
    def __init__(self, surfaces: Sequence[Surface], A: Array, spacing_m: float) -> None:
        self.surfaces, self.A = surfaces, A
        self.size = size_of(surfaces)
        self.spacing = spacing_m
        draw = np.random.default_rng(0)
        i, j = _different_motions(A)
        one, other = np.r_[i, j], np.r_[j, i]
        self.used = sorted({*one})
        moved = {k: surfaces[k].faces.points[draw.integers(0, len(surfaces[k].faces.points), MOVED)] for k in self.used}
        self.pairs = _Pairs(np.array([moved[k] for k in one]), other, A[other] @ se3.inverse(A[one]))
        self.fine = {k: surfaces[k].faces for k in self.used}
        self.coarse = {}
        for k, faces in self.fine.items():
            few = draw.permutation(len(faces.points))[:COARSE]
            self.coarse[k] = Features(faces.points[few], faces.normals[few])

    def starts(self) -> Array:
        """Poses (H, 4, 4): each rotation with the translation by which the views' centres meet best."""
        R = rotations(ROTATIONS)
        W = se3.inverse(self.A)  # T_targetcarrier_sensorcarrier
        centres = np.array([each.faces.points.mean(axis=0) for each in self.surfaces])
        # R_W (R_Y c + t_Y) + t_W = p, the same for all views
        rows = np.concatenate([W[:, :3, :3], np.broadcast_to(-np.eye(3), (len(W), 3, 3))], axis=2).reshape(-1, 6)
        right = -(np.einsum("nij,hjk,nk->hni", W[:, :3, :3], R, centres) + W[:, :3, 3]).reshape(len(R), -1)
        solved = np.linalg.lstsq(rows, right.T, rcond=1e-3)[0]
        misfit = ((rows @ solved - right.T) ** 2).sum(axis=0)
        return se3.pose(R, solved[:3].T)[np.argsort(misfit)[: ROTATIONS // 2]]

    def near(self, Y: Array, gate: float, *, fine: bool) -> Iterator[tuple[Array, Array, Features, Array, np.ndarray]]:
        """By pair at poses (H, 4, 4): T_other_one, points moved by it (3, H, m), the other's surface, and distances and
        places (H, m) of what is nearest there."""
        inverse = se3.inverse(Y)
        for points, other, motion in zip(self.pairs.points, self.pairs.others, self.pairs.motions, strict=True):
            T = inverse @ motion @ Y
            turned = T[:, :3, :3].transpose(1, 0, 2).reshape(-1, 3) @ points.T
            moved = turned.reshape(3, len(Y), -1) + T[:, :3, 3].T[:, :, None]
            faces = self.fine[other] if fine else self.coarse[other]
            distances, at = (each.reshape(len(Y), -1) for each in faces.nearest(moved.reshape(3, -1).T, gate))
            yield T, moved, faces, distances, at

    def look(self, Y: Array, gate: float, *, fine: bool) -> tuple[Array, Array]:
        """Misfits and near shares (H, P) of poses (H, 4, 4)."""
        distances = [each[3] for each in self.near(Y, gate, fine=fine)]
        misfits = [(np.minimum(each / gate, 1.0) ** 2).mean(axis=1) for each in distances]
        return np.array(misfits).T, np.array([np.isfinite(each).mean(axis=1) for each in distances]).T

    def told(self, Y: Array, gate: float, *, fine: bool) -> tuple[Array, Array]:
        """Gradients (H, 6) and normal matrices (H, 6, 6) of poses (H, 4, 4)."""
        gradient, normal = np.zeros((len(Y), 6)), np.zeros((len(Y), 6, 6))
        for T, moved, faces, distances, at in self.near(Y, gate, fine=fine):
            weights = np.maximum(1.0 - (distances / gate) ** 2, 0.0) ** 2
            normals = faces.normals.T.take(at, axis=1)
            residuals = (normals * (moved - faces.points.T.take(at, axis=1))).sum(axis=0)
            rows = across(moved, normals)
            with_residuals = np.concatenate([rows, residuals[None]]).transpose(1, 2, 0)
            sums = (weights * rows).transpose(1, 0, 2) @ with_residuals
            # d T = exp(Ad(T) x - x) T for Y exp(x)
            by_Y = se3.adjoint(T) - np.eye(6)
            to_Y = by_Y.transpose(0, 2, 1)
            gradient += (to_Y @ sums[:, :, 6:])[:, :, 0]
            normal += to_Y @ sums[:, :, :6] @ by_Y
        return gradient, normal

    def refined(self, Y: Array, gate: float, steps: int, *, fine: bool) -> tuple[Array, Array]:
        """Poses after some damped steps, and their misfits."""
        units = np.r_[np.ones(3), np.full(3, self.size)]
        for _ in range(steps):
            gradient, normal = self.told(Y, gate, fine=fine)
            normal = normal * units[:, None] * units
            damping = 1e-3 * np.trace(normal, axis1=1, axis2=2)[:, None, None] / 6.0 + 1e-12
            x = -np.linalg.solve(normal + damping * np.eye(6), (gradient * units)[..., None])[..., 0] * units
            x *= np.minimum(1.0, 0.5 / np.maximum(np.linalg.norm(x[:, :3], axis=1), 1e-9))[:, None]
            Y = Y @ se3.expmap(x)
        return Y, self.look(Y, gate, fine=fine)[0]

    def apart(self, Y: Array, misfits: Array, most: int) -> tuple[Array, Array]:
        """The best poses, each once."""
        kept: list[int] = []
        for k in np.argsort(misfits.mean(axis=1)):
            between = se3.logmap(se3.inverse(Y[kept]) @ Y[k]) if kept else np.zeros((0, 6))
            far = np.linalg.norm(between[:, :3], axis=1) > SAME[0]
            far |= np.linalg.norm(between[:, 3:], axis=1) > SAME[1] * self.size
            if far.all() and len(kept) < most:
                kept.append(int(k))
        return Y[kept], misfits[kept]


def _different_motions(A: Array) -> tuple[np.ndarray, np.ndarray]:
    """Pairs (i, j) of views whose relative rotations differ most from each other."""
    i, j = np.triu_indices(len(A), 1)
    turns = se3.so3_logmap((A[i] @ se3.inverse(A[j]))[:, :3, :3])
    angles = np.linalg.norm(turns, axis=1)
    near = np.flatnonzero(angles < WIDE)
    at = near if len(near) >= 3 else np.arange(len(i))
    chosen = [int(at[np.argmax(angles[at])])]
    distance = np.full(len(at), np.inf)
    while len(chosen) < min(PAIRS, len(at)):
        last = turns[chosen[-1]]
        away = np.minimum(np.linalg.norm(turns[at] - last, axis=1), np.linalg.norm(turns[at] + last, axis=1))
        distance = np.minimum(distance, away)
        chosen.append(int(at[np.argmax(distance)]))
    return i[chosen], j[chosen]


def first_poses(surfaces: Sequence[Surface], A: Array, spacing_m: float, start: Array | None = None) -> list[Start]:
    """Poses of the sensor on its carrier that explain the clouds, the best first; more than one: they are ambiguous.

    ``A`` (N, 4, 4) is T_sensorcarrier_targetcarrier of each surface; ``start`` (4, 4) a guess, near which to look.
    """
    search = _Search(surfaces, A, spacing_m)
    Y = search.starts() if start is None else start[None]
    for share, steps, most in STAGES if start is None else STAGES[-1:]:
        gate = share * search.size
        Y, misfits = search.refined(Y, gate, steps, fine=share < 0.3)
        Y, misfits = search.apart(Y, misfits, most)
    gate = LAST[0] * spacing_m
    Y, _ = search.apart(*search.refined(Y, gate, LAST[1], fine=True), len(Y))
    misfits, near = search.look(Y, gate, fine=True)
    best, *others = (Start(*each) for each in zip(Y, misfits, near, strict=True))
    return [best, *(each for each in others if _is_another(search, best, each, gate))]


def _is_another(search: _Search, best: Start, other: Start, gate: float) -> bool:
    """Whether another start explains the clouds as well, and is no other end of the same flat valley."""
    worse = other.misfits - best.misfits
    if worse.mean() > CLEARLY * worse.std() / np.sqrt(len(worse)):
        return False
    first = best.T_sensorcarrier_sensor
    halfway = se3.expmap(0.5 * se3.logmap((se3.inverse(first) @ other.T_sensorcarrier_sensor)[None]))
    over = search.look(first @ halfway, gate, fine=True)[0][0] - other.misfits
    return bool(over.mean() > CLEARLY * over.std() / np.sqrt(len(over)))
