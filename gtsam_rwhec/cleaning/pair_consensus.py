"""Gross outliers of one pair, by consensus on its own A X = Y B (RWHEC paper, Section 9, eq. 66).

The paper knows Y and asks which measurements agree on X. Here neither is known: a hypothesis is X, Y (and a scale) of a
few measurements, in closed form, all hypotheses at once; the one that most measurements agree with is fitted again to
those that do. What it is for is gross errors (another tag's id, a reflection, a flipped pose): robust refinement
(``robust="gnc"``) does the fine work.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gtsam_rwhec.cleaning.removed import Kept, RemovalReason
from gtsam_rwhec.errors import OptionError
from gtsam_rwhec.geometry.poses import Array


@dataclass(frozen=True)
class ConsensusOptions:
    """Limits of agreement; the paper's are the defaults.

    Attributes
    ----------
    max_translation_m, max_rotation_rad : float
        Within which of its prediction a measurement agrees: 0.6 m and 60 degrees.
    min_inlier_share : float
        Below it the pair's measurements are all removed.
    scale_known : bool
        Whether target lengths are known.
    max_scale_error : float
        With an unknown scale: how far from 1 it may be (tag sizes known within 10 %).
    hypotheses : int
        Samples drawn.
    sample_size : int
        Measurements each.
    seed : int
    """

    max_translation_m: float = 0.6
    max_rotation_rad: float = float(np.radians(60.0))
    min_inlier_share: float = 1.0 / 3.0
    scale_known: bool = True
    max_scale_error: float = 0.1
    hypotheses: int = 200
    sample_size: int = 4
    seed: int = 0

    def __post_init__(self) -> None:
        for name in ("max_translation_m", "max_rotation_rad", "hypotheses", "sample_size"):
            if not getattr(self, name) > 0:
                raise OptionError(f"ConsensusOptions.{name}={getattr(self, name)!r}; it must be positive")
        for name in ("min_inlier_share", "max_scale_error"):
            if not 0.0 < getattr(self, name) <= 1.0:
                raise OptionError(f"ConsensusOptions.{name}={getattr(self, name)!r}; give one above 0 and up to 1")


@dataclass(frozen=True)
class Consensus:
    """Which measurements agree (``kept``), how many, and the hypothesis they agree on: X, Y (4, 4), scale."""

    kept: Kept
    share: float
    X: Array
    Y: Array
    scale: float


def find_consensus(A: Array, B: Array, stamps_ns: np.ndarray, options: ConsensusOptions | None = None) -> Consensus:
    """Sort out a pair's measurements.

    Parameters
    ----------
    A, B : (N, 4, 4) arrays
        T_sensorcarrier_targetcarrier and T_sensor_target, metres.
    stamps_ns : (N,) integers
    options : ConsensusOptions, optional

    Returns
    -------
    Consensus
        A pair with a single measurement is removed whole: nothing can validate it. With two, which agree with what is
        fitted to them almost always, the limits still apply.
    """
    options = options or ConsensusOptions()
    N = len(A)
    if N < 2:
        kept = Kept.of(np.ones(N, dtype=bool), RemovalReason.SINGLE, stamps_ns, np.ones(N), 2.0)
        return Consensus(kept, 0.0, np.eye(4), np.eye(4), 1.0)
    generator = np.random.default_rng(options.seed)
    size = min(options.sample_size, N)
    # Each row a sample without repetition: the first of a random order.
    samples = np.argsort(generator.random((options.hypotheses, N)), axis=1)[:, :size]
    mask, hypothesis = _best(A, B, *closed_form(A[samples], B[samples], options), options)
    for _ in range(10):  # fitted to what agrees, until the same agree
        if mask.sum() < 2:
            break
        X, Y, scale = closed_form(A[mask][None], B[mask][None], options)
        again, fitted = _best(A, B, X, Y, scale, options)
        if again.sum() < mask.sum():
            break
        stable = np.array_equal(again, mask)
        mask, hypothesis = again, fitted
        if stable:
            break
    share = float(mask.mean())
    X_best, Y_best, s_best = hypothesis
    metres, radians = (v[0] for v in distances(A, B, X_best[None], Y_best[None], np.array([s_best])))
    if share < options.min_inlier_share:
        everything = np.ones(N, dtype=bool)
        kept = Kept.of(everything, RemovalReason.NO_CONSENSUS, stamps_ns, np.full(N, share), options.min_inlier_share)
        return Consensus(kept, share, X_best, Y_best, s_best)
    turned, moved = radians > options.max_rotation_rad, metres > options.max_translation_m
    kept = Kept.of(turned, RemovalReason.ROTATION_OFF, stamps_ns, radians, options.max_rotation_rad)
    kept = kept.and_of(moved, RemovalReason.TRANSLATION_OFF, stamps_ns, metres, options.max_translation_m)
    return Consensus(kept, share, X_best, Y_best, s_best)


def closed_form(A: Array, B: Array, options: ConsensusOptions) -> tuple[Array, Array, Array]:
    """X, Y (H, 4, 4) and scale (H,) of H samples of n measurements, A and B (H, n, 4, 4).

    Rotations first (Shah 2013): sum R_A (x) R_B turns vec R_X into n vec R_Y; its first singular vectors, brought to
    SO(3), are R_Y and R_X. Then translations and scale by least squares, of minimum norm where a sample leaves some
    free.
    """
    H, n = A.shape[:2]
    R_A, R_B = A[..., :3, :3], B[..., :3, :3]
    # R_Y = R_A R_X R_B': vec over rows, K[(i, j), (k, l)] = sum R_A[i, k] R_B[j, l]
    K = np.einsum("hnik,hnjl->hijkl", R_A, R_B).reshape(H, 9, 9) / n
    U, _, Vt = np.linalg.svd(K)
    R_X, R_Y = _rotation(Vt[:, 0].reshape(H, 3, 3)), _rotation(U[:, :, 0].reshape(H, 3, 3))
    # A singular vector's sign is arbitrary, the pair's is not: the better of the two rotations near each.
    rows = np.zeros((H, n, 3, 6 + (not options.scale_known)))
    rows[..., 0:3], rows[..., 3:6] = R_A, -np.eye(3)
    seen = np.einsum("hij,hnj->hni", R_Y, B[..., :3, 3])
    right = seen - A[..., :3, 3]
    if not options.scale_known:  # R_A t_X + t_A - t_Y = (1 / s) R_Y t_B
        rows[..., 6] = -seen
        right = -A[..., :3, 3]
    solution = _least_squares(rows, right)
    scale: Array = np.ones(H)
    if not options.scale_known:
        low, high = 1.0 / (1.0 + options.max_scale_error), 1.0 / (1.0 - options.max_scale_error)
        inverse = np.clip(solution[:, 6], low, high)
        # At a limit the translations are others. So it is where the motion does not tell the scale: turning in place.
        at_limit = inverse != solution[:, 6]
        if at_limit.any():
            right = inverse[at_limit, None, None] * seen[at_limit] - A[at_limit, ..., :3, 3]
            solution[at_limit, :6] = _least_squares(rows[at_limit, ..., :6], right)
        scale = 1.0 / inverse
    X, Y = np.zeros((H, 4, 4)), np.zeros((H, 4, 4))
    X[:, 3, 3] = Y[:, 3, 3] = 1.0
    X[:, :3, :3], Y[:, :3, :3] = R_X, R_Y
    X[:, :3, 3], Y[:, :3, 3] = solution[:, :3], solution[:, 3:6]
    return X, Y, scale


def _least_squares(rows: Array, right: Array) -> Array:
    """(H, k) solutions of minimum norm of rows (H, n, 3, k) and right sides (H, n, 3)."""
    H, n, _, k = rows.shape
    inverse = np.linalg.pinv(rows.reshape(H, 3 * n, k), rcond=1e-6)
    solution: Array = np.einsum("hij,hj->hi", inverse, right.reshape(H, 3 * n))
    return solution


def _rotation(M: Array) -> Array:
    """The nearest rotation to (H, 3, 3) matrices known up to sign: det M tells which sign."""
    M = M * np.where(np.linalg.det(M) < 0.0, -1.0, 1.0)[:, None, None]
    U, _, Vt = np.linalg.svd(M)
    U[:, :, 2] *= np.linalg.det(U @ Vt)[:, None]
    rotation: Array = U @ Vt
    return rotation


def distances(A: Array, B: Array, X: Array, Y: Array, scale: Array) -> tuple[Array, Array]:
    """How far each of N measurements is from each of H hypotheses: metres and radians, (H, N)."""
    R = np.einsum("hji,njk,hkl->hnil", Y[:, :3, :3], A[:, :3, :3], X[:, :3, :3])  # predicted R_B
    c = np.einsum("nij,hj->hni", A[:, :3, :3], X[:, :3, 3]) + A[:, :3, 3] - Y[:, None, :3, 3]
    t = np.einsum("hji,hnj->hni", Y[:, :3, :3], c)
    metres = np.linalg.norm(t - B[:, :3, 3] / scale[:, None, None], axis=2)
    trace = np.einsum("hnij,nij->hn", R, B[:, :3, :3])
    return metres, np.arccos(np.clip(0.5 * (trace - 1.0), -1.0, 1.0))


def _best(
    A: Array, B: Array, X: Array, Y: Array, scale: Array, options: ConsensusOptions
) -> tuple[np.ndarray, tuple[Array, Array, float]]:
    """The hypothesis that most agree with; of equals the one with the smaller distances."""
    metres, radians = distances(A, B, X, Y, scale)
    agree = (metres <= options.max_translation_m) & (radians <= options.max_rotation_rad)
    size = metres / options.max_translation_m + radians / options.max_rotation_rad
    score = agree.sum(axis=1) - np.where(agree, size, 0.0).sum(axis=1) / (2.0 * len(A) + 1.0)
    best = int(np.argmax(score))
    return agree[best], (X[best], Y[best], float(scale[best]))
