"""Absolute poses stacked over all pairs, and the linear systems of A X = Y B that the closed forms share.

Rotations first (eq. 8a): R_A R_X = R_Y R_B, linear in the matrices' entries. Then translations (eq. 8b) for known
rotations: R_A t_X - t_Y + alpha t_A = R_Y t_B. Both without weights, as their authors have them. All sums over
measurements are matrix products; loops are over pairs.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from gtsam_rwhec.errors import ScaleError, UnderdeterminedError
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.methods.estimate import Outcome, Poses
from gtsam_rwhec.problem.moments import Gauge, Moments, MomentStack, edge_forms
from gtsam_rwhec.problem.pairs import Pair
from gtsam_rwhec.problem.problem import Problem
from gtsam_rwhec.solver.parts import connected_components
from gtsam_rwhec.solver.rotations import project

#: A second solution whose equations are this well satisfied, relatively, is one: exact data with a free direction.
FREE = 1e-10


@dataclass(frozen=True)
class Stack:
    """Measurements of all pairs, one after the other.

    A, B (N, 4, 4), sigma and kappa (N,); target and sensor (N,) are indices into ``targets`` and ``sensors``; pairs
    (E, 2) the same of each pair, whose measurements are first[e] to first[e + 1]. ``gauge`` has origins near the data.
    """

    targets: tuple[str, ...]
    sensors: tuple[str, ...]
    A: Array
    B: Array
    sigma: Array
    kappa: Array
    target: np.ndarray
    sensor: np.ndarray
    pairs: np.ndarray
    first: np.ndarray
    gauge: Gauge

    @staticmethod
    def of(problem: Problem) -> Stack:
        """Of a problem with raw measurements."""
        raw = [problem.measurements(*pair) for pair in problem.pairs]
        targets = {name: i for i, name in enumerate(problem.targets)}
        sensors = {name: i for i, name in enumerate(problem.sensors)}
        pairs = np.array([(targets[target], sensors[sensor]) for target, sensor in problem.pairs])
        counts = np.array([len(one.A) for one in raw])
        indices = np.repeat(pairs, counts, axis=0)
        return Stack(
            problem.targets,
            problem.sensors,
            np.concatenate([one.A for one in raw]),
            np.concatenate([one.B for one in raw]),
            np.concatenate([one.sigma for one in raw]),
            np.concatenate([one.kappa for one in raw]),
            indices[:, 0],
            indices[:, 1],
            pairs,
            np.concatenate([[0], np.cumsum(counts)]),
            problem.gauge,
        )

    @property
    def counts(self) -> np.ndarray:
        """(E,) measurements of each pair."""
        return np.diff(self.first)

    @property
    def centred_t_A(self) -> Array:
        """(N, 3) translations of A about the gauge, which takes its origins off t_X and t_Y (DESIGN fact 9)."""
        centred: Array = self.A[:, :3, 3] + self.A[:, :3, :3] @ self.gauge.target_carrier - self.gauge.sensor_carrier
        return centred

    def outcome(
        self,
        R_X: Array,
        t_X: Array,
        R_Y: Array,
        t_Y: Array,
        *,
        starts_from: str | None = None,
        notes: Iterable[str] = (),
    ) -> Outcome[Poses]:
        """Rotations (n, 3, 3) and translations (n, 3), metres, of targets and of sensors, by name; of known scale."""
        X, Y = poses_by_name(self.targets, R_X, t_X), poses_by_name(self.sensors, R_Y, t_Y)
        return Outcome(X, Y, starts_from=starts_from, notes=tuple(notes))

    def sums(self, rows: Array) -> Array:
        """(E, ...) sums of (N, ...) rows over each pair's measurements."""
        summed: Array = np.add.reduceat(rows, self.first[:-1], axis=0)
        return summed


def poses_by_name(names: tuple[str, ...], R: Array, t: Array) -> dict[str, Array]:
    """Rotations (n, 3, 3) and translations (n, 3) as (4, 4) poses by name."""
    T = np.tile(np.eye(4), (len(names), 1, 1))
    T[:, :3, :3], T[:, :3, 3] = R, t
    return dict(zip(names, T, strict=True))


def rotation_products(stack: Stack) -> Array:
    """K (E, 9, 9), the sum of R_B (x) R_A over each pair: vec(R_Y)' K vec(R_X) is the sum of <R_A R_X R_B', R_Y>."""
    K = np.empty((len(stack.pairs), 3, 3, 3, 3))
    R_A = np.ascontiguousarray(stack.A[:, :3, :3]).reshape(-1, 9)
    R_B = np.ascontiguousarray(stack.B[:, :3, :3]).reshape(-1, 9)
    for e in range(len(stack.pairs)):
        rows = slice(stack.first[e], stack.first[e + 1])
        K[e] = (R_B[rows].T @ R_A[rows]).reshape(3, 3, 3, 3)
    return K.transpose(0, 1, 3, 2, 4).reshape(-1, 9, 9)


def linear_rotations(stack: Stack) -> tuple[Array, Array]:
    """R_X (n_X, 3, 3) and R_Y (n_Y, 3, 3) of least |R_A R_X - R_Y R_B|, as matrices of unit norm, then projected.

    The smallest eigenvector of the normal equations, component by component; with one X and one Y it consists of the
    two singular vectors of the largest singular value of K (Shah 2013), since the blocks on the diagonal are N I.

    Raises
    ------
    UnderdeterminedError
        When, as with parallel axes, the smallest eigenvalue is not alone.
    """
    n_X, n_Y = len(stack.targets), len(stack.sensors)
    K = rotation_products(stack)
    H = np.zeros((n_X + n_Y, 9, n_X + n_Y, 9))
    number = np.zeros(n_X + n_Y)
    np.add.at(number, stack.pairs[:, 0], stack.counts)
    np.add.at(number, n_X + stack.pairs[:, 1], stack.counts)
    for frame in range(n_X + n_Y):
        H[frame, :, frame, :] = number[frame] * np.eye(9)
    for (j, k), product in zip(stack.pairs, K, strict=True):
        H[n_X + k, :, j, :] -= product
        H[j, :, n_X + k, :] -= product.T
    names = stack.targets + stack.sensors
    place = {name: i for i, name in enumerate(names)}
    named_pairs = tuple(Pair(stack.targets[j], stack.sensors[k]) for j, k in stack.pairs)
    R = np.empty((n_X + n_Y, 3, 3))
    for component in connected_components(named_pairs):
        at = np.array([place[name] for name in component])
        block = H[at][:, :, at].reshape(9 * len(at), 9 * len(at))
        values, vectors = np.linalg.eigh(block)
        if values[1] <= FREE * values[-1]:
            raise UnderdeterminedError(
                f"the rotations of {', '.join(sorted(component))} are not determined: the rotations measured are all "
                "the same, turn about parallel axes or by half turns alone; turn about a second axis"
            )
        R[at] = rotations_up_to_sign(vectors[:, 0].reshape(-1, 3, 3).transpose(0, 2, 1))
    return R[:n_X], R[n_X:]


def rotations_up_to_sign(V: Array) -> Array:
    """Matrices (n, 3, 3), known up to a factor of either sign, as the nearest right-handed rotations."""
    signs = np.where(np.linalg.det(V) < 0.0, -1.0, 1.0)
    return project(signs[:, None, None] * V)


def linear_outcome(stack: Stack, R_X: Array, R_Y: Array, notes: Iterable[str] = ()) -> Outcome[Poses]:
    """The outcome of a method that finds rotations first: with the ``linear_translations`` for them."""
    t_X, t_Y, _ = linear_translations(stack, R_X, R_Y)
    return stack.outcome(R_X, t_X, R_Y, t_Y, notes=notes)


def linear_translations(
    stack: Stack, R_X: Array, R_Y: Array, *, unknown_scale: bool = False
) -> tuple[Array, Array, float]:
    """t_X (n_X, 3), t_Y (n_Y, 3) in metres and alpha of least |R_A t_X - t_Y + alpha t_A - R_Y t_B| (eq. 8b).

    Raises
    ------
    UnderdeterminedError
        When they are not determined by the rotations measured (or, with unknown scale, by the translations).
    ScaleError
        When the scale comes out zero or negative.
    """
    n_X, n_Y = len(stack.targets), len(stack.sensors)
    n = n_X + n_Y
    R_A, t_A = stack.A[:, :3, :3], stack.centred_t_A
    b = np.einsum("nij,nj->ni", R_Y[stack.sensor], stack.B[:, :3, 3])
    normal = np.zeros((3 * n + 1, 3 * n + 1))
    right = np.zeros(3 * n + 1)
    blocks = normal[:-1, :-1].reshape(n, 3, n, 3)  # a view
    back = R_A.transpose(0, 2, 1)
    sums = zip(
        stack.pairs,
        stack.counts,
        stack.sums(R_A),
        stack.sums(np.einsum("nij,nj->ni", back, t_A)),
        stack.sums(t_A),
        stack.sums(np.einsum("nij,nj->ni", back, b)),
        stack.sums(b),
        strict=True,
    )
    for (j, k), count, of_R, of_Rt, of_t, of_Rb, of_b in sums:
        X, Y = slice(3 * j, 3 * j + 3), slice(3 * (n_X + k), 3 * (n_X + k) + 3)
        blocks[j, :, j, :] += count * np.eye(3)
        blocks[n_X + k, :, n_X + k, :] += count * np.eye(3)
        blocks[n_X + k, :, j, :] -= of_R
        blocks[j, :, n_X + k, :] -= of_R.T
        normal[X, -1] += of_Rt
        normal[Y, -1] -= of_t
        right[X] += of_Rb
        right[Y] -= of_b
    normal[-1, :] = normal[:, -1]
    normal[-1, -1] = np.einsum("ni,ni->", t_A, t_A)
    right[-1] = np.einsum("ni,ni->", t_A, b)
    if not unknown_scale:
        right = right[:-1] - normal[:-1, -1]
        normal = normal[:-1, :-1]
    scaling = 1.0 / np.sqrt(np.maximum(np.diag(normal), 1e-300))
    equilibrated = normal * scaling[:, None] * scaling
    if np.linalg.eigvalsh(equilibrated)[0] <= FREE:
        raise UnderdeterminedError(
            "the translations are not determined: the rotations measured leave a direction free"
            + (", or the scale (move along more than one circle or sphere)" if unknown_scale else "")
        )
    numbers = scaling * np.linalg.solve(equilibrated, scaling * right)
    alpha = float(numbers[-1]) if unknown_scale else 1.0
    if alpha <= 0.0:
        raise ScaleError(f"the linear system for the translations has scale {alpha:.6g}, which no real target has")
    t = numbers[: 3 * n].reshape(n, 3) / alpha
    return t[:n_X] + stack.gauge.target_carrier, t[n_X:] + stack.gauge.sensor_carrier, alpha


def plain_form(stack: Stack) -> Array:
    """Q (25, 25) of one pair: x' Q x is half the sum of |R_A t_X + t_A - t_Y - R_Y t_B|^2 + |R_A R_X - R_Y R_B|_F^2.

    x = [t_X, t_Y, 1, vec R_X, vec R_Y], translations about the stack's gauge; no use is made of R_X and R_Y being
    rotations.
    """
    ones = np.ones(len(stack.A))
    moments = Moments.of(stack.A, stack.B, ones, ones, stack.gauge, False, "-".join([*stack.targets, *stack.sensors]))
    stacked = MomentStack.of([moments], [False])
    translation, rotation = edge_forms(stacked.translation, stacked.rotation, stacked.kappa)
    form: Array = translation[0] + rotation[0]
    return form
