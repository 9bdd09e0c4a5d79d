"""Which measurements belong to an answer: a test of each under the noise that the kept ones show.

Truncation on the way has one noise for all axes and cuts at a fixed quantile, so of good measurements it leaves out
some, and more where the noise is larger along one axis. This costs accuracy where there is no outlier at all. So at the
end every measurement is judged anew. Its residual e = Log(B^-1 Y^-1 A X), in the sensor's axes, has the variances V of
the kept measurements by axis, and the estimate's own: V - J C J' where the measurement was part of the fit, V + J C J'
where it was not (both are the deletion residual's test; Cook and Weisberg, Residuals and Influence in Regression, 1982,
Section 2.2.2). With nu degrees of freedom

    e' (V -+ J C J')^-1 e  <=  6 F(6, nu)'s quantile at 1 - 0.05 / N

holds for all N good measurements together with a probability of 95 % or more (Bonferroni).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from rwhec_factors.batch import BatchResiduals
from scipy.special import chdtri, fdtri

from gtsam_rwhec.fitting.weighted_fit import Measured, WeightedFit
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.problem.knowledge import ScaleMode
from gtsam_rwhec.problem.problem import Problem

#: All good measurements are kept with at least this probability, if their noise is Gaussian.
ALL_KEPT = 0.95
#: A measurement's residual has these components: three of rotation, three of translation.
DOF = 6
#: A variance by axis is pulled towards the mean of its three axes with the weight of so many measurements, and a
#: sensor's towards that of all sensors.
PRIOR_MEASUREMENTS = 10.0
#: With more unknowns than this the estimate's own covariance is left out: its matrix would be large, and there are many
#: measurements for each frame.
MOST_UNKNOWNS = 600
#: Directions with less than this part of the largest information are free: no residual depends on them.
FREE = 1e-12
#: Variances are at least this, in units of the noise as stated, so that exact data can be divided by them.
SMALLEST = 1e-30


def rejected_share(confidence: float, count: int) -> float:
    """The probability at which one good measurement of ``count`` is rejected.

    It is at most 1 - confidence, and so small that all good measurements together are kept with ``ALL_KEPT``.
    """
    return min(1.0 - confidence, (1.0 - ALL_KEPT) / max(count, 1))


def inlier_threshold(confidence: float, count: int) -> float:
    """The largest squared residual of an inlier among ``count`` measurements, for known noise: chi-square, 6 axes."""
    return float(chdtri(DOF, rejected_share(confidence, count)))


@dataclass(frozen=True)
class Judged:
    """The test of every measurement."""

    #: (N,): e' (V -+ J C J')^-1 e; infinite where a frame has no pose.
    square: Array
    #: The quantile that it is compared with.
    threshold: float

    @property
    def agrees(self) -> np.ndarray:
        """(N,): which measurements belong to the answer."""
        agreeing: np.ndarray = self.square <= self.threshold
        return agreeing


@dataclass(frozen=True)
class _Linear:
    """Residuals in units of the noise as stated, (N, 6), and their Jacobian: blocks (N, 6, w), columns (N, w).

    A column of -1 has no unknown.
    """

    e: Array
    blocks: Array
    columns: np.ndarray
    #: The unknowns' number.
    size: int
    #: (N,): the number of the measurement's sensor.
    sensor: np.ndarray
    #: (N,): whether both frames have poses.
    known: np.ndarray


def judged(
    problem: Problem,
    measured: Measured,
    fit: WeightedFit,
    keep: np.ndarray,
    confidence: float,
    *,
    noise_of: np.ndarray | None = None,
    robust: bool = False,
) -> Judged:
    """Judge every measurement at a fit to the kept ones (N,).

    ``noise_of`` (N,) are the measurements that show the noise, all kept ones by default. ``robust`` takes the variances
    from medians: for a fit to all measurements, of which some may be outliers.
    """
    linear = _linearized(problem, measured, fit)
    keep = keep & linear.known
    noise_of = keep if noise_of is None else noise_of & linear.known
    count = int(noise_of.sum())
    nu = max(0.5 * (DOF * count - linear.size), 1.0)
    threshold = DOF * float(fdtri(DOF, nu, 1.0 - rejected_share(confidence, len(keep))))
    variances = _variances(linear, noise_of, robust=robust)
    square = np.full(len(keep), np.inf)
    if linear.size > MOST_UNKNOWNS:
        square[linear.known] = np.sum(linear.e**2 / variances, axis=1)[linear.known]
        return Judged(square, threshold)
    e, own = _as_if_fitted(linear, keep, variances)
    for _ in range(2):  # the step moves residuals a little, and these the variances
        variances = _variances(_with(linear, e), noise_of, robust=robust)
        e, own = _as_if_fitted(linear, keep, variances)
    C = np.where(keep[:, None, None], -own, own)
    C[:, np.arange(DOF), np.arange(DOF)] += variances
    # A measurement without which something is undetermined has no residual of its own.
    values, vectors = np.linalg.eigh(C / np.sqrt(variances[:, :, None] * variances[:, None, :]))
    whitened = np.einsum("nij,ni->nj", vectors, e / np.sqrt(variances))
    parts = np.where(values > 1e-6, whitened**2 / np.maximum(values, 1e-6), 0.0)
    square[linear.known] = parts.sum(axis=1)[linear.known]
    return Judged(square, threshold)


def _with(linear: _Linear, e: Array) -> _Linear:
    return _Linear(e, linear.blocks, linear.columns, linear.size, linear.sensor, linear.known)


def _linearized(problem: Problem, measured: Measured, fit: WeightedFit) -> _Linear:
    """Residuals and Jacobians of all measurements at a fit."""
    count = len(measured.A)
    free = [name for name in problem.targets + problem.sensors if name not in problem.fixed and name in fit.poses]
    first = {name: 6 * i for i, name in enumerate(free)}
    scales = _scale_columns(problem.scale, problem, 6 * len(free))
    e, blocks = np.zeros((count, 6)), np.zeros((count, 6, 13))
    columns = np.full((count, 13), -1)
    sensor, known = np.zeros(count, dtype=int), np.zeros(count, dtype=bool)
    numbers = {name: i for i, name in enumerate(problem.sensors)}
    for pair, rows in zip(measured.pairs, measured.rows, strict=True):
        sensor[rows] = numbers[pair.sensor]
        alpha = fit.alpha.get(pair.target, np.nan)
        if pair.target not in fit.poses or pair.sensor not in fit.poses or not (np.isfinite(alpha) and alpha > 0.0):
            continue
        known[rows] = True
        at = BatchResiduals(measured.A[rows], measured.B[rows]).linearize(
            fit.poses[pair.target], fit.poses[pair.sensor], alpha
        )
        parts = (at.target, at.sensor, at.scale[:, :, None])
        W = _whitening(measured, rows)
        e[rows] = np.einsum("nij,nj->ni", W, at.residual)
        blocks[rows] = W @ np.concatenate(parts, axis=2)
        for name, at_column in ((pair.target, 0), (pair.sensor, 6)):
            if name in first:
                columns[rows, at_column : at_column + 6] = first[name] + np.arange(6)
        columns[rows, 12] = scales.get(pair.target, -1)
    blocks[np.broadcast_to((columns < 0)[:, None, :], blocks.shape)] = 0.0
    return _Linear(e, blocks, columns, 6 * len(free) + len(set(scales.values())), sensor, known)


def _scale_columns(mode: ScaleMode, problem: Problem, first: int) -> dict[str, int]:
    """The column of each target's unknown scale."""
    owners = dict.fromkeys(pair.target for pair in problem.pairs)
    if mode == "known":
        return {}
    if mode == "shared":
        return dict.fromkeys(owners, first)
    return {name: first + i for i, name in enumerate(name for name in owners if name not in problem.fixed_scales)}


def _whitening(measured: Measured, rows: slice) -> Array:
    """Into units of the noise as stated, and the sensor's axes where one number is stated for all three."""
    if measured.whitening is not None:
        return measured.whitening[rows]
    R_B = measured.B[rows, :3, :3]
    W = np.zeros((len(R_B), 6, 6))
    W[:, :3, :3] = np.sqrt(2.0 * measured.kappa[rows])[:, None, None] * R_B
    W[:, 3:, 3:] = R_B / measured.sigma[rows][:, None, None]
    return W


def _variances(linear: _Linear, keep: np.ndarray, *, robust: bool) -> Array:
    """Variances (N, 6) of the residuals, by axis and sensor."""
    spare = max(1.0 - linear.size / (DOF * max(int(keep.sum()), 1)), 0.05)  # the unknowns take the rest

    def of(rows: np.ndarray) -> Array:
        square = linear.e[rows] ** 2
        if robust:
            middle: Array = np.median(square, axis=0) / float(chdtri(1, 0.5)) / spare
            return middle
        mean: Array = square.mean(axis=0) / spare
        return mean

    if not keep.any():
        return np.full(linear.e.shape, SMALLEST)
    by_axis = of(keep)
    mean = np.repeat(by_axis.reshape(2, 3).mean(axis=1), 3)
    count = float(keep.sum())
    pooled = (count * by_axis + PRIOR_MEASUREMENTS * mean) / (count + PRIOR_MEASUREMENTS)
    result = np.tile(pooled, (len(keep), 1))
    for number in np.unique(linear.sensor[keep]):
        own = linear.sensor == number
        count = float((own & keep).sum())
        result[own] = (count * of(own & keep) + PRIOR_MEASUREMENTS * pooled) / (count + PRIOR_MEASUREMENTS)
    return np.maximum(result, SMALLEST)


def _as_if_fitted(linear: _Linear, keep: np.ndarray, variances: Array) -> tuple[Array, Array]:
    """Residuals (N, 6) after a Gauss-Newton step of the kept ones under the variances, and J C J' (N, 6, 6)."""
    size, width = linear.size, linear.blocks.shape[2]
    at = np.where(linear.columns < 0, size, linear.columns)  # a last row and column take what has no unknown
    weighted = linear.blocks[keep] / variances[keep][:, :, None]
    pairs = at[keep]
    products = np.einsum("nij,nik->njk", weighted, linear.blocks[keep])
    flat = pairs[:, :, None] * (size + 1) + pairs[:, None, :]
    information = _summed(flat, products, (size + 1) ** 2).reshape(size + 1, size + 1)
    gradient = _summed(pairs, np.einsum("nij,ni->nj", weighted, linear.e[keep]), size + 1)
    C = np.zeros((size + 1, size + 1))
    C[:-1, :-1] = _inverse(information[:-1, :-1])
    step = -C @ gradient
    e = linear.e + np.einsum("nij,nj->ni", linear.blocks, step[at])
    local = C[at[:, :, None], at[:, None, :]].reshape(len(at), width, width)
    return e, linear.blocks @ local @ linear.blocks.transpose(0, 2, 1)


def _summed(places: np.ndarray, values: Array, size: int) -> Array:
    result: Array = np.asarray(np.bincount(places.ravel(), values.ravel(), size), dtype=np.float64)
    return result


def _inverse(information: Array) -> Array:
    """The inverse over the directions that are not free."""
    unit = np.sqrt(np.maximum(np.diagonal(information), np.finfo(float).tiny))
    values, vectors = np.linalg.eigh(information / unit[:, None] / unit)
    part = np.where(values > FREE * max(float(values.max(initial=0.0)), 1e-300), values, np.inf)
    inverse: Array = (vectors / part) @ vectors.T / unit[:, None] / unit
    return inverse
