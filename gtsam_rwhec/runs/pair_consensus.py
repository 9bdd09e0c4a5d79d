"""Gross outliers of one pair, found by consensus on its own A X = Y B (RWHEC paper, Section 9, eq. 66).

The paper knows Y and asks which measurements agree on X. Here neither X nor Y is known. A hypothesis is X, Y (and a
scale) from a few measurements, in closed form; all hypotheses are computed at once. The hypothesis that most
measurements agree with is fitted again to the measurements that agree. This step removes gross errors: the id of
another tag, a reflection, a flipped pose. Robust refinement (``robust="gnc"``) finds the small ones.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gtsam_rwhec.errors import OptionError
from gtsam_rwhec.geometry.blas_threads import one_blas_thread
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.results.log_history import Kept, RemovalReason
from gtsam_rwhec.solver.sample_poses import poses_of_samples

#: A hypothesis is fitted at most this often to the measurements that agree with it. Most need two or three fits.
MOST_FITS = 10


@dataclass(frozen=True)
class ConsensusOptions:
    """Limits of agreement; the defaults are the paper's."""

    max_translation_m: float = 0.6  #: a measurement agrees if it is this near to its prediction
    max_rotation_rad: float = float(np.radians(60.0))
    min_inlier_share: float = 1.0 / 3.0  #: if a smaller share of a pair agrees, all of its measurements are removed
    scale_known: bool = True  #: whether the target's length is known
    max_scale_error: float = 0.1  #: how far an unknown scale may be from 1: tag sizes are known within 10 %
    hypotheses: int = 200  #: number of samples
    sample_size: int = 4  #: measurements in each sample
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
    """The measurements that agree (``kept``), their share, and their hypothesis: X, Y (4, 4) and scale."""

    kept: Kept
    share: float
    X: Array
    Y: Array
    scale: float


@one_blas_thread()
def find_consensus(A: Array, B: Array, stamps_ns: np.ndarray, options: ConsensusOptions | None = None) -> Consensus:
    """Keep the measurements of a pair that agree on one hypothesis.

    A and B (N, 4, 4) are T_sensorcarrier_targetcarrier and T_sensor_target, metres; `stamps_ns` is (N,). A single
    measurement is removed: nothing can validate it. Two measurements almost always agree with what is fitted to them,
    but the limits still apply.
    """
    options = options or ConsensusOptions()
    N = len(A)
    everything = np.ones(N, dtype=bool)
    if N < 2:
        kept = Kept.of(everything, RemovalReason.SINGLE, stamps_ns, np.ones(N), 2.0)
        return Consensus(kept, 0.0, np.eye(4), np.eye(4), 1.0)
    generator = np.random.default_rng(options.seed)
    # Each row is a sample without repetition: the beginning of a random order.
    order = np.argsort(generator.random((options.hypotheses, N)), axis=1)
    samples = order[:, : min(options.sample_size, N)]
    best = _best(A, B, hypotheses_of(A[samples], B[samples], options), options)
    for _ in range(MOST_FITS):
        mask = best.agrees
        if mask.sum() < 2:
            break
        again = _best(A, B, hypotheses_of(A[mask][None], B[mask][None], options), options)
        if again.agrees.sum() < mask.sum():
            break
        best = again
        if np.array_equal(again.agrees, mask):
            break
    share = float(best.agrees.mean())
    if share < options.min_inlier_share:
        shares = np.full(N, share)
        kept = Kept.of(everything, RemovalReason.NO_CONSENSUS, stamps_ns, shares, options.min_inlier_share)
    else:
        kept = Kept.within(
            stamps_ns,
            (RemovalReason.ROTATION_OFF, best.radians, options.max_rotation_rad),
            (RemovalReason.TRANSLATION_OFF, best.metres, options.max_translation_m),
        )
    return Consensus(kept, share, best.X, best.Y, best.scale)


def hypotheses_of(A: Array, B: Array, options: ConsensusOptions) -> tuple[Array, Array, Array]:
    """X, Y (H, 4, 4) and scale (H,) of H samples of n measurements, A and B (H, n, 4, 4)."""
    limits = (1.0 - options.max_scale_error, 1.0 + options.max_scale_error)
    return poses_of_samples(A, B, is_scaled=not options.scale_known, scales=limits)


def distances(A: Array, B: Array, X: Array, Y: Array, scale: Array) -> tuple[Array, Array]:
    """How far each of N measurements is from each of H hypotheses: metres and radians, (H, N)."""
    # of R_B' R_Y' R_A R_X: all products of entries that are of hypotheses, with all that are of measurements
    of_hypotheses = (Y[:, :3, :3, None, None] * X[:, None, None, :3, :3]).reshape(-1, 81)
    of_measurements = (A[:, :3, None, :3, None] * B[:, None, :3, None, :3]).reshape(-1, 81)
    trace = of_hypotheses @ of_measurements.T
    c = np.einsum("nij,hj->hni", A[:, :3, :3], X[:, :3, 3]) + A[:, :3, 3] - Y[:, None, :3, 3]
    t = np.einsum("hji,hnj->hni", Y[:, :3, :3], c)
    metres = np.linalg.norm(t - B[:, :3, 3] / scale[:, None, None], axis=2)
    return metres, np.arccos(np.clip(0.5 * (trace - 1.0), -1.0, 1.0))


@dataclass(frozen=True)
class _Best:
    """A hypothesis X, Y, scale; the distances (N,) of the measurements from it, and which measurements agree."""

    agrees: np.ndarray
    metres: Array
    radians: Array
    X: Array
    Y: Array
    scale: float


def _best(A: Array, B: Array, hypotheses: tuple[Array, Array, Array], options: ConsensusOptions) -> _Best:
    """The hypothesis that most measurements agree with. Among equals it has the smallest distances."""
    X, Y, scale = hypotheses
    metres, radians = distances(A, B, X, Y, scale)
    agree = (metres <= options.max_translation_m) & (radians <= options.max_rotation_rad)
    size = metres / options.max_translation_m + radians / options.max_rotation_rad
    score = agree.sum(axis=1) - np.where(agree, size, 0.0).sum(axis=1) / (2.0 * len(A) + 1.0)
    best = int(np.argmax(score))
    return _Best(agree[best], metres[best], radians[best], X[best], Y[best], float(scale[best]))
