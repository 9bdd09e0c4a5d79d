"""Measurements of all pairs in one stack, and the linear systems of A X = Y B that the closed forms share.

The rotations come first (eq. 8a): R_A R_X = R_Y R_B is linear in the matrices' entries. The translations follow
(eq. 8b) for known rotations: R_A t_X - t_Y + alpha t_A = R_Y t_B. Neither has weights, as in the authors' papers.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from rwhec_factors.se3 import pose, so3_nearest

from gtsam_rwhec.errors import ScaleError, UnderdeterminedError
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.geometry.quaternions import left, of_rotations
from gtsam_rwhec.methods.method import Outcome, Poses
from gtsam_rwhec.problem.many_measurements import Sorted
from gtsam_rwhec.problem.measurements import Measurements, Pair
from gtsam_rwhec.problem.moments import Gauge
from gtsam_rwhec.problem.problem import Problem
from gtsam_rwhec.solver.full_form import edge_forms
from gtsam_rwhec.solver.parts import connected_components

#: Up to this smallest eigenvalue over the largest, normal equations are singular: exact data leave a direction free.
FREE = 1e-10


def solve_scaled(normal: Array, right: Array, undetermined: str, smallest: float = FREE) -> Array:
    """Solve the normal equations; all unknowns are scaled alike, so that the choice of units loses no digits.

    Raises UnderdeterminedError with the text ``undetermined`` when an eigenvalue of the scaled matrix is at most
    ``smallest``.
    """
    scaling = 1.0 / np.sqrt(np.maximum(np.diag(normal), 1e-300))
    scaled = normal * scaling[:, None] * scaling
    if np.linalg.eigvalsh(scaled)[0] <= smallest:
        raise UnderdeterminedError(undetermined)
    return scaling * np.linalg.solve(scaled, scaling * right)


@dataclass(frozen=True)
class Stack:
    """Measurements A, B (N, 4, 4) of all pairs, metres, one pair after the other.

    Arrays of n frames have the order of ``names``: targets, then sensors. ``target`` and ``sensor`` (N,) are each
    measurement's indices into ``names``, ``pairs`` (E, 2) each pair's. The measurements of pair e are first[e], ...,
    first[e + 1] - 1. The ``gauge`` has origins near the data, metres; ``origins`` (n, 3) has each frame's.
    """

    targets: tuple[str, ...]
    sensors: tuple[str, ...]
    A: Array
    B: Array
    target: np.ndarray
    sensor: np.ndarray
    pairs: np.ndarray
    first: np.ndarray
    gauge: Gauge

    @staticmethod
    def of(problem: Problem) -> Stack:
        """The stack of a problem with raw measurements."""
        raw = [problem.measurements(*pair) for pair in problem.pairs]
        names = problem.targets + problem.sensors
        pairs = np.array([(names.index(pair.target), names.index(pair.sensor)) for pair in problem.pairs])
        counts = [len(measurements.A) for measurements in raw]
        target, sensor = np.repeat(pairs, counts, axis=0).T
        A, B = (np.concatenate([getattr(measurements, side) for measurements in raw]) for side in "AB")
        first = np.concatenate([[0], np.cumsum(counts)])
        return Stack(problem.targets, problem.sensors, A, B, target, sensor, pairs, first, problem.gauge)

    @property
    def names(self) -> tuple[str, ...]:
        """Targets, then sensors."""
        return self.targets + self.sensors

    @property
    def origins(self) -> Array:
        """(n, 3) origins near the data, metres."""
        gauges = np.array([self.gauge.target_carrier, self.gauge.sensor_carrier])
        return np.repeat(gauges, [len(self.targets), len(self.sensors)], axis=0)

    @property
    def counts(self) -> np.ndarray:
        """(E,) measurements of each pair."""
        return np.diff(self.first)

    @property
    def centred_t_A(self) -> Array:
        """(N, 3) translations of A about the gauge; t_X and t_Y are then relative to its points (design fact 9)."""
        return self.A[:, :3, 3] + self.A[:, :3, :3] @ self.gauge.target_carrier - self.gauge.sensor_carrier

    def outcome(
        self, R: Array, t: Array, scale: float = 1.0, *, starts_from: str | None = None, notes: Iterable[str] = ()
    ) -> Outcome[Poses]:
        """Rotations (n, 3, 3) and translations (n, 3), metres, as a method's outcome."""
        T = pose(R, t)
        poses = dict(zip(self.names, T, strict=True))
        X, Y = ({name: poses[name] for name in names} for names in (self.targets, self.sensors))
        return Outcome(X, Y, scale, starts_from=starts_from, notes=tuple(notes))

    def sums(self, rows: Array) -> Array:
        """(E, ...) sums of (N, ...) rows over each pair's measurements."""
        return np.add.reduceat(rows, self.first[:-1], axis=0)

    def by_pair(self, rows: Array) -> list[Array]:
        """(N, ...) rows as one array for each pair."""
        return np.split(rows, self.first[1:-1])


def rotation_products(stack: Stack) -> Array:
    """K (E, 9, 9), the sum of R_B (x) R_A over each pair: vec(R_Y)' K vec(R_X) is the sum of <R_A R_X R_B', R_Y>."""
    R_A, R_B = (stack.by_pair(T[:, :3, :3].reshape(-1, 9)) for T in (stack.A, stack.B))
    K = np.array([b.T @ a for a, b in zip(R_A, R_B, strict=True)]).reshape(-1, 3, 3, 3, 3)
    return K.transpose(0, 1, 3, 2, 4).reshape(-1, 9, 9)


def linear_rotations(stack: Stack) -> Array:
    """R (n, 3, 3): the matrices of unit norm that minimise |R_A R_X - R_Y R_B|, projected to rotations.

    The answer is the smallest eigenvector of the normal equations, component by component. With one X and one Y it
    consists of the two singular vectors of the largest singular value of K (Shah 2013), since the diagonal blocks are
    N I. Raises UnderdeterminedError when the smallest eigenvalue is not alone, as with parallel axes.
    """
    n = len(stack.names)
    H = np.zeros((n, 9, n, 9))
    for (j, k), count, K in zip(stack.pairs, stack.counts, rotation_products(stack), strict=True):
        H[j, :, j] += count * np.eye(9)
        H[k, :, k] += count * np.eye(9)
        H[k, :, j] -= K
        H[j, :, k] -= K.T
    R = np.empty((n, 3, 3))
    for component in connected_components(tuple(Pair(stack.names[j], stack.names[k]) for j, k in stack.pairs)):
        at = np.array([stack.names.index(name) for name in component])
        values, vectors = np.linalg.eigh(H[at][:, :, at].reshape(9 * len(at), 9 * len(at)))
        if values[1] <= FREE * values[-1]:
            raise UnderdeterminedError(
                f"the measurements do not determine the rotations of {', '.join(sorted(component))}: the measured "
                "rotations are all the same, turn about parallel axes, or are half turns; turn about a second axis"
            )
        R[at] = rotations_up_to_sign(vectors[:, 0].reshape(-1, 3, 3).transpose(0, 2, 1))
    return R


def rotations_up_to_sign(V: Array) -> Array:
    """The nearest rotations (det = 1) to matrices (n, 3, 3) that are known up to a factor of either sign."""
    signs = np.where(np.linalg.det(V) < 0.0, -1.0, 1.0)
    return so3_nearest(signs[:, None, None] * V)


def linear_outcome(stack: Stack, R: Array, notes: Iterable[str] = ()) -> Outcome[Poses]:
    """The outcome of a method that finds rotations first: ``linear_translations`` completes the poses."""
    return stack.outcome(R, *linear_translations(stack, R), notes=notes)


def linear_translations(stack: Stack, R: Array, *, unknown_scale: bool = False) -> tuple[Array, float]:
    """t (n, 3) in metres and alpha that minimise |R_A t_X - t_Y + alpha t_A - R_Y t_B| (eq. 8b), given R (n, 3, 3).

    Raises UnderdeterminedError when the measured rotations do not determine t (or, with unknown scale, the translations
    do not determine alpha), and ScaleError when alpha is not positive.
    """
    n = len(R)
    b = np.einsum("nij,nj->ni", R[stack.sensor], stack.B[:, :3, 3])
    minus_I = np.broadcast_to(-np.eye(3), (len(b), 3, 3))
    rows = np.concatenate([stack.A[:, :3, :3], minus_I, stack.centred_t_A[:, :, None], b[:, :, None]], axis=2)
    sums = np.zeros((3 * n + 2, 3 * n + 2))  # of all t, alpha, and the right-hand side
    for (j, k), pair_rows in zip(stack.pairs, stack.by_pair(rows), strict=True):
        own = pair_rows.reshape(-1, 8)
        at = np.r_[3 * j : 3 * j + 3, 3 * k : 3 * k + 3, 3 * n, 3 * n + 1]
        sums[np.ix_(at, at)] += own.T @ own
    undetermined = "the translations are not determined: the rotations measured leave a direction free"
    if unknown_scale:
        undetermined += ", or the scale (move along more than one circle or sphere)"
        numbers = solve_scaled(sums[:-1, :-1], sums[:-1, -1], undetermined)
        alpha = float(numbers[-1])
    else:
        numbers, alpha = solve_scaled(sums[:-2, :-2], sums[:-2, -1] - sums[:-2, -2], undetermined), 1.0
    if alpha <= 0.0:
        raise ScaleError(f"the linear system for the translations has scale {alpha:.6g}; a real scale is positive")
    return numbers[: 3 * n].reshape(n, 3) / alpha + stack.origins, alpha


def plain_form(stack: Stack) -> Array:
    """Q (25, 25) of one pair: x' Q x is half the sum of |R_A t_X + t_A - t_Y - R_Y t_B|^2 + |R_A R_X - R_Y R_B|_F^2.

    x = [t_X, t_Y, 1, vec R_X, vec R_Y], translations about the stack's gauge; R_X and R_Y may be any matrices.
    """
    one, pair = np.array(1.0), Pair("-".join(stack.targets), "-".join(stack.sensors))
    stacked = Sorted.of(pair, Measurements(stack.A, stack.B, one, one)).moments(stack.gauge, with_R_B=True)
    translation, rotation = edge_forms(stacked.translations(slice(None)), stacked.rotations(slice(None)), stacked.kappa)
    form: Array = translation[0] + rotation[0]
    return form


def poses_of(stack: Stack, x: Array) -> tuple[Array, Array]:
    """R (2, 3, 3) and t (2, 3), metres, of [t_X, t_Y, vec R_X, vec R_Y] (24,), whose matrices are projected."""
    R = rotations_up_to_sign(x[6:].reshape(2, 3, 3).transpose(0, 2, 1))
    return R, x[:6].reshape(2, 3) + stack.origins


def paired_quaternions(stack: Stack) -> tuple[Array, Array]:
    """q_A and q_B (N, 4) with signs that fit: <q_A q_X, q_Y q_B> > 0 for the linear system's rotations."""
    q_A, q_B = of_rotations(stack.A[:, :3, :3]), of_rotations(stack.B[:, :3, :3])
    q = of_rotations(linear_rotations(stack))
    return q_A, np.where(agreement(q_A, q[stack.target], q[stack.sensor], q_B) < 0.0, -1.0, 1.0)[:, None] * q_B


def agreement(q_A: Array, q_X: Array, q_Y: Array, q_B: Array) -> Array:
    """<q_A q_X, q_Y q_B> (N,): the cosine of half the residual's angle, negative where the signs do not fit."""
    product: Array = np.einsum("nij,nj,nik,nk->n", left(q_A), q_X, left(q_Y), q_B)
    return product
