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
class _PairRows:
    """A pair's residuals e (n, 6) in units of the noise as stated, and their Jacobian J (n, 6, w) by unknowns (w,)."""

    rows: slice
    sensor: str
    e: Array
    J: Array
    unknowns: np.ndarray
    seen: np.ndarray  #: (n, 6): which residuals are measured


def judged(
    problem: Problem,
    measured: Measured,
    fit: WeightedFit,
    keep: np.ndarray,
    confidence: float,
    *,
    noise_of: np.ndarray | None = None,
    robust: bool = False,
) -> np.ndarray:
    """Which measurements (N,) are inliers, by a fit to those in ``keep`` (N,).

    The noise is estimated from those in ``noise_of`` (N,), by default all kept ones. ``robust`` takes the variances
    from medians: for a fit to all measurements, of which some may be outliers.
    """
    pairs, size = _linearized(problem, measured, fit)
    known = np.zeros(len(keep), dtype=bool)
    for pair in pairs:
        known[pair.rows] = True
    keep = keep & known
    noise_of = keep if noise_of is None else noise_of & known
    nu = max(0.5 * (float(measured.told[noise_of].sum()) - size), 1.0)
    threshold = DOF * float(fdtri(DOF, nu, 1.0 - rejected_share(confidence, len(keep))))
    square = np.full(len(keep), np.inf)
    residuals = [pair.e for pair in pairs]
    variances = _variances(pairs, residuals, noise_of, size, robust=robust)
    if size > MOST_UNKNOWNS:
        for pair, variance in zip(pairs, variances, strict=True):
            square[pair.rows] = np.sum(pair.e**2 / variance, axis=1)
        return measured.as_of_six(square) <= threshold
    for _ in range(2):  # the step moves residuals a little, and these the variances
        residuals, _ = _as_if_fitted(pairs, keep, variances, size)
        variances = _variances(pairs, residuals, noise_of, size, robust=robust)
    residuals, C = _as_if_fitted(pairs, keep, variances, size)
    for pair, e, variance in zip(pairs, residuals, variances, strict=True):
        own = pair.J @ C[np.ix_(pair.unknowns, pair.unknowns)] @ pair.J.transpose(0, 2, 1)
        own *= np.where(keep[pair.rows], -1.0, 1.0)[:, None, None]
        deviation = np.sqrt(variance)
        share = np.eye(DOF) + own / deviation[:, None] / deviation
        # A measurement without which something is undetermined has no residual of its own.
        values, vectors = np.linalg.eigh(share)
        whitened = np.einsum("nij,ni->nj", vectors, e / deviation)
        square[pair.rows] = np.where(values > 1e-6, whitened**2 / np.maximum(values, 1e-6), 0.0).sum(axis=1)
    return measured.as_of_six(square) <= threshold


def _linearized(problem: Problem, measured: Measured, fit: WeightedFit) -> tuple[list[_PairRows], int]:
    """Residuals and Jacobians at a fit, of the pairs whose frames have poses; and the number of all unknowns."""
    free = [name for name in problem.targets + problem.sensors if name not in problem.fixed and name in fit.poses]
    first = {name: DOF * i for i, name in enumerate(free)}
    owners = [] if problem.scale == "known" else dict.fromkeys(pair.target for pair in problem.pairs)
    owners = [name for name in owners if name not in problem.fixed_scales]
    shared = problem.scale == "shared"
    scales = {name: DOF * len(free) + (0 if shared else i) for i, name in enumerate(owners)}
    pairs = []
    for pair, rows in zip(measured.pairs, measured.rows, strict=True):
        alpha = fit.alpha.get(pair.target, np.nan)
        if pair.target not in fit.poses or pair.sensor not in fit.poses or not (np.isfinite(alpha) and alpha > 0.0):
            continue
        at = BatchResiduals(measured.A[rows], measured.B[rows]).linearize(
            fit.poses[pair.target], fit.poses[pair.sensor], alpha
        )
        blocks: dict[int, Array] = {}
        for name, J in ((pair.target, at.target), (pair.sensor, at.sensor)):  # of a motion one frame is both
            if name in first:
                blocks[first[name]] = blocks.get(first[name], 0.0) + J
        if pair.target in scales:
            blocks[scales[pair.target]] = at.scale[:, :, None]
        unknowns = [np.arange(start, start + J.shape[2]) for start, J in blocks.items()]
        W = _whitening(measured, rows)
        J = np.concatenate([np.zeros((len(W), DOF, 0)), *blocks.values()], axis=2)
        e = np.einsum("nij,nj->ni", W, at.residual) * measured.seen[rows]
        columns = np.concatenate([np.zeros(0, dtype=np.int64), *unknowns])
        pairs.append(_PairRows(rows, pair.sensor, e, W @ J, columns, measured.seen[rows]))
    return pairs, DOF * len(free) + len(set(scales.values()))


def _whitening(measured: Measured, rows: slice) -> Array:
    """Into units of the noise as stated, and the sensor's axes where one number is stated for all three."""
    if measured.whitening is not None:
        return measured.whitening[rows]
    R_B = measured.B[rows, :3, :3]
    W = np.zeros((len(R_B), 6, 6))
    W[:, :3, :3] = np.sqrt(2.0 * measured.kappa[rows])[:, None, None] * R_B
    W[:, 3:, 3:] = R_B / measured.sigma[rows][:, None, None]
    return W


def _variances(
    pairs: list[_PairRows], residuals: list[Array], keep: np.ndarray, size: int, *, robust: bool
) -> list[Array]:
    """Variances (6,) of each pair's residuals, by axis and sensor."""
    # What is not measured is no residual.
    kept = [np.where(pair.seen, e, np.nan)[keep[pair.rows]] for pair, e in zip(pairs, residuals, strict=True)]
    number = sum(map(len, kept))
    if not number:
        return [np.full(DOF, SMALLEST) for _ in pairs]
    spare = max(1.0 - size / max(sum(int(np.isfinite(e).sum()) for e in kept), 1), 0.05)  # the unknowns take the rest

    def of(parts: list[Array]) -> Array:
        square = np.concatenate(parts) ** 2
        has = np.isfinite(square).any(axis=0)
        result, square = np.ones(DOF), square[:, has]
        if robust:
            result[has] = np.nanmedian(square, axis=0) / float(chdtri(1, 0.5)) / spare
        else:
            result[has] = np.nanmean(square, axis=0) / spare
        return result

    by_axis = of(kept)
    mean = np.repeat(by_axis.reshape(2, 3).mean(axis=1), 3)
    pooled = (number * by_axis + PRIOR_MEASUREMENTS * mean) / (number + PRIOR_MEASUREMENTS)
    of_sensor: dict[str, Array] = {}
    for name in dict.fromkeys(pair.sensor for pair in pairs):
        own = [part for pair, part in zip(pairs, kept, strict=True) if pair.sensor == name]
        count = sum(map(len, own))
        of_sensor[name] = (
            (count * of(own) + PRIOR_MEASUREMENTS * pooled) / (count + PRIOR_MEASUREMENTS) if count else pooled
        )
    return [np.maximum(of_sensor[pair.sensor], SMALLEST) for pair in pairs]


def _as_if_fitted(
    pairs: list[_PairRows], keep: np.ndarray, variances: list[Array], size: int
) -> tuple[list[Array], Array]:
    """Residuals after a Gauss-Newton step of the kept ones under the variances, and the unknowns' covariance C."""
    information, gradient = np.zeros((size, size)), np.zeros(size)
    for pair, variance in zip(pairs, variances, strict=True):
        kept = keep[pair.rows]
        J = np.concatenate(pair.J[kept] / np.sqrt(variance)[:, None]) if kept.any() else pair.J[:0, 0]
        information[np.ix_(pair.unknowns, pair.unknowns)] += J.T @ J
        gradient[pair.unknowns] += J.T @ (pair.e[kept] / np.sqrt(variance)).ravel()
    C = _inverse(information)
    step = -C @ gradient
    return [pair.e + pair.J @ step[pair.unknowns] for pair in pairs], C


def _inverse(information: Array) -> Array:
    """The inverse over the directions that are not free."""
    unit = np.sqrt(np.maximum(np.diagonal(information), np.finfo(float).tiny))
    values, vectors = np.linalg.eigh(information / unit[:, None] / unit)
    part = np.where(values > FREE * max(float(values.max(initial=0.0)), 1e-300), values, np.inf)
    inverse: Array = (vectors / part) @ vectors.T / unit[:, None] / unit
    return inverse
