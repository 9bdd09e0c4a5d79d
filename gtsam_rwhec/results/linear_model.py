"""The measurements about the answer as one linear model, at the level of poses: residuals, noise and derivatives.

The residual of a measurement is r = Log(P^-1 B), with the prediction P = S(Y^-1 A X): it is the error of B in the
target's axes. To first order, with right perturbations x of X and y of Y and the scale s,

    r(d) = r - D (x - Ad(P^-1) y) - [0; R' t] ds,    D = diag(1, 1, 1, s, s, s)

Its noise is B's, as it was found, and A's, moved into the same axes. Clocks, intrinsics, boards and errors that
measurements share are not in it: what is computed from it says so.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from rwhec_factors import se3

from gtsam_rwhec.calibration.calibration_record import Calibration
from gtsam_rwhec.fitting.fit_options import CarrierNoise
from gtsam_rwhec.fitting.refined import PairNoise
from gtsam_rwhec.fitting.unknowns import Unknown, UnknownKind
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.problem.directions import SLIDES, scaled, sliding_part
from gtsam_rwhec.problem.measurements import Pair
from gtsam_rwhec.problem.problem import Problem

#: Directions with less than this share of the largest information, in units of their own, count as free.
FREE = 1e-12
#: A measurement's unknowns: six of its target, six of its sensor, and the scale.
OWN = 13


@dataclass(frozen=True, eq=False)
class LinearModel:
    """All measurements of frames that the answer has, pair after pair."""

    pairs: tuple[Pair, ...]
    stamps_ns: np.ndarray | None  #: None where a pair has none
    frames: dict[str, slice]  #: Where the frames' six unknowns are
    dimension: int
    pair: np.ndarray  #: Each measurement's place in ``pairs``
    within: np.ndarray  #: Its place among the measurements of its pair
    used: np.ndarray
    residual: Array  #: [rad, m], in the target's axes, lengths as measured
    noise: Array  #: Its covariance before the fit
    J: Array  #: The change of the prediction by the measurement's own unknowns
    places: np.ndarray  #: Where these are among all unknowns; ``dimension`` stands for one that is known
    A: Array  #: The carriers' poses

    @staticmethod
    def of(rows: Mapping[Pair, MeasuredRows], calibration: Calibration) -> LinearModel | None:
        """The model of a calibration's measurements; None where it has no covariances, and so no noise."""
        refined = calibration.refined
        known = [pair for pair in rows if pair.target in calibration.X and pair.sensor in calibration.Y]
        known = [pair for pair in known if refined is not None and pair in refined.noise and len(rows[pair].A)]
        if refined is None or not known:
            return None
        free = [name for name in (*calibration.X, *calibration.Y) if Unknown.of(name) in refined.joint.slots]
        frames = {name: slice(6 * i, 6 * i + 6) for i, name in enumerate(free)}
        scales = [one for one in refined.joint.slots if one.kind is UnknownKind.SCALE]
        dimension = 6 * len(free) + len(scales)
        parts = []
        for number, pair in enumerate(known):
            of, count = rows[pair], len(rows[pair].A)
            scale = refined.scale if isinstance(refined.scale, float) else refined.scale[pair.target]
            X, Y = calibration.X[pair.target].matrix(), calibration.Y[pair.sensor].matrix()
            P = np.linalg.inv(Y) @ of.A @ X
            noise = _noise_of_B(of, refined.noise[pair]) + noise_of_A(calibration.noise_of_A, of.A, X, scale)
            J = derivatives(P, scale)
            P[:, :3, 3] *= scale
            own = next((i for i, one in enumerate(scales) if one.owner in ("", pair.target)), None)
            at = np.r_[
                _places(frames.get(pair.target), dimension),
                _places(frames.get(pair.sensor), dimension),
                dimension if own is None else 6 * len(free) + own,
            ]
            residual = se3.logmap(se3.inverse(P) @ of.B)
            places = np.tile(at, (count, 1))
            parts.append((np.full(count, number), np.arange(count), of.used, residual, noise, J, places, of.A))
        stamps = [rows[pair].stamps_ns for pair in known]
        together = [one for one in stamps if one is not None]
        stamps_ns = np.concatenate(together) if len(together) == len(stamps) else None
        arrays = (np.concatenate(part) for part in zip(*parts, strict=True))
        return LinearModel(tuple(known), stamps_ns, frames, dimension, *arrays)

    @property
    def seconds(self) -> Array:
        """Time (N,) since the first measurement; without stamps, the place in its pair."""
        if self.stamps_ns is None:
            return self.within.astype(float)
        seconds: Array = (self.stamps_ns - self.stamps_ns.min()) * 1e-9
        return seconds

    @property
    def by_sensor(self) -> dict[str, np.ndarray]:
        """Which measurements (N,) each sensor made, in the order of the pairs."""
        names = np.array([pair.sensor for pair in self.pairs])[self.pair]
        return {name: names == name for name in dict.fromkeys(pair.sensor for pair in self.pairs)}

    def whitened(self) -> tuple[Array, Array]:
        """Residuals (N, 6) and derivatives (N, 6, 13) in units of the noise."""
        L = np.linalg.cholesky(self.noise)
        both = np.linalg.solve(L, np.concatenate([self.residual[:, :, None], self.J], axis=2))
        return both[:, :, 0], both[:, :, 1:]

    def information(self, J: Array, which: np.ndarray) -> Array:
        """J'J (d, d) of some measurements (N,) bool, with whitened derivatives ``J``."""
        total, rows = np.zeros((self.dimension + 1, self.dimension + 1)), J[which]
        first = np.flatnonzero(np.diff(self.pair[which], prepend=-1))
        at = self.places[which][first]
        of_pairs = np.add.reduceat(rows.transpose(0, 2, 1) @ rows, first)
        np.add.at(total, (at[:, :, None], at[:, None]), of_pairs)
        return total[:-1, :-1]

    def gradient(self, J: Array, r: Array, which: np.ndarray) -> Array:
        """J'r (d,) of some measurements, whitened."""
        total = np.zeros(self.dimension + 1)
        np.add.at(total, self.places[which], np.einsum("nij,ni->nj", J[which], r[which]))
        return total[:-1]


def inverse_of(information: Array) -> Array:
    """The covariance: the inverse of an information; along free directions it is zero, for nothing is moved there."""
    scaled, unit = equilibrated(information)
    values, vectors = np.linalg.eigh(scaled)
    known = values > FREE * values.max(initial=0.0)
    vectors = vectors[:, known] * unit[:, None]
    result: Array = (vectors / values[known]) @ vectors.T
    return result


def equilibrated(information: Array) -> tuple[Array, Array]:
    """The information with ones on its diagonal, and the units in which it is so."""
    unit = 1.0 / np.sqrt(np.maximum(np.diagonal(information), 1e-300))
    return information * unit[:, None] * unit, unit


def _places(where: slice | None, dimension: int) -> np.ndarray:
    """Six places of a frame; a frame that is fixed has none."""
    return np.full(6, dimension) if where is None else np.arange(where.start, where.stop)


def _noise_of_B(of: MeasuredRows, typical: PairNoise) -> Array:
    """B's covariances (N, 6, 6): as stated, so that the median measurement of the pair has the noise that was found.

    What slides is no noise, and stays.
    """
    if of.covariance is None:
        return np.tile(np.diag(np.repeat([typical.rotation_rad**2, typical.translation_m**2], 3)), (len(of.A), 1, 1))
    slides = np.zeros_like(of.covariance)
    if np.einsum("nii->n", of.covariance).max(initial=0.0) >= SLIDES:
        slides = sliding_part(of.covariance)
    mean = np.einsum("nii->ni", of.covariance - slides).reshape(-1, 2, 3).mean(axis=2)
    usual = np.median(mean[of.used] if of.used.any() else mean, axis=0)
    found = np.array([typical.rotation_rad, typical.translation_m])
    factor = np.where((usual > 0.0) & (found > 0.0), found / np.sqrt(np.maximum(usual, 1e-300)), 1.0)
    return scaled(of.covariance, slides, np.repeat(factor, 3))


def derivatives(P: Array, scale: float = 1.0) -> Array:
    """Derivatives (N, 6, 13) of predictions (N, 4, 4), in true lengths, by target, sensor and scale."""
    as_measured = np.repeat([1.0, scale], 3)
    J = np.zeros((len(P), 6, OWN))
    J[:, :, :6] = np.diag(as_measured)
    J[:, :, 6:12] = -as_measured[:, None] * se3.adjoint(se3.inverse(P))
    J[:, 3:, 12] = np.einsum("nji,nj->ni", P[:, :3, :3], P[:, :3, 3])
    return J


def noise_of_A(noise: CarrierNoise | None, A: Array, X: Array, scale: float = 1.0) -> Array:
    """A's covariance in the prediction's axes (N, 6, 6); zero where A counts as exact."""
    if noise is None:
        return np.zeros((len(A), 6, 6))
    frame = X if noise.about == "targetcarrier" else A @ X
    E = np.repeat([1.0, scale], 3)[:, None] * se3.adjoint(se3.inverse(np.broadcast_to(frame, A.shape)))
    E = E * np.repeat([noise.rotation_rad, noise.translation_m], 3)
    moved: Array = E @ E.transpose(0, 2, 1)
    return moved


@dataclass(frozen=True, eq=False)
class MeasuredRows:
    """The measurements of a pair, used or not."""

    #: T_sensorcarrier_targetcarrier at the final time offsets, and T_sensor_target, metres
    A: Array
    B: Array
    stamps_ns: np.ndarray | None
    #: Covariance of B's right perturbation [omega (rad), v (m)], as stated; None where a log has none
    covariance: Array | None
    reasons: tuple[str, ...]  #: Why a measurement is not used; empty where it is

    @property
    def used(self) -> np.ndarray:
        """Which measurements are in the answer, (N,) bool."""
        return np.array([not reason for reason in self.reasons], dtype=bool)


#: The reason for a measurement that robust estimation left out.
LEFT_OUT = "farther off than the noise of the others explains"


def measured_rows(problem: Problem, calibration: Calibration) -> Mapping[Pair, MeasuredRows]:
    """The measurements of a problem, in the order of their pairs; motions are left out, for they see no target.

    Raises
    ------
    MeasurementsNotKeptError
        The problem was made with ``keep_measurements=False``.
    """
    rows = {}
    for pair in problem.pairs:
        if pair.is_motion:
            continue
        measured = problem.measurements(pair.target, pair.sensor)
        inlier = calibration.outliers.inliers.get(pair)
        used = np.ones(len(measured.A), dtype=bool) if inlier is None else np.asarray(inlier, dtype=bool)
        rows[pair] = MeasuredRows(
            A=measured.A,
            B=measured.B,
            stamps_ns=measured.stamps_ns,
            covariance=measured.covariance_of_B(),
            reasons=tuple("" if one else LEFT_OUT for one in used),
        )
    return rows
