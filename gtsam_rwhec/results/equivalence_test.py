"""The test for "off by less than the limit in this volume": a bound on a small rigid error from touched points.

A calibration that is off by a small motion delta = [omega, v] (or [omega, v, s] with a scale) moves the point p by
J(p) delta = omega x p + v (+ s p). Its error in a volume is the largest |J(p) delta| over the points of the volume; as
|J(p) delta| is convex in p, that is at a corner of it. "Off by the limit or more" is a union: at some corner p, in some
direction u, u'J(p) delta >= limit. Each part is tested by Student's one-sided t at 5 %, and the calibration is accepted
only if every part is rejected. The probability of a false acceptance is then at most that of one part, 5 %, whatever
the layout, the number of touches and the error are (intersection-union test: Berger 1982; Berger and Hsu 1996,
Statistical Science 11:283; in one dimension Schuirmann's two one-sided tests, 1987, J. Pharmacokin. Biopharm. 15:657).
So the bound is the largest over p and u of

    u'J(p) d + t sqrt(u'J(p) Cov J(p)'u)

with the least-squares estimate d, its covariance Cov, and Student's 95 % quantile t. No correction for the number of
corners is due. (Statements "more than" are of an intersection; their bound holds for all p and u at once: Scheffe.)

A camera's noise along its line of sight differs from that across it. Both variances are estimated from the residuals
(without bias: Rao's MINQUE), and the degrees of freedom of their sum are Satterthwaite's (1946).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from rwhec_factors import se3
from scipy.special import chdtrc, fdtri, ndtri, stdtrit

from gtsam_rwhec.geometry.poses import Array

#: Singular values below this share of the largest are none: the touches leave their direction free.
NULL = 1e-6
#: The noise along the line of sight is estimated by itself from so many degrees of freedom of the residuals on.
SEPARATE = 6.0
#: It is taken as at least this share of the variance of both together: few residuals may show none by chance.
LEAST_SHARE = 0.1
#: Directions u that are tried first, and steps that climb from the best of them.
DIRECTIONS, STEPS = 200, 30
#: The chance with which a calibration whose error is the estimated one is accepted after the touches that are asked
#: for, and the most that are asked for.
CHANCE, MOST_TOUCHES = 0.8, 10_000
#: So many corners are compared as places for the next touches.
MOST_PLACES = 60
#: Stated noise is contradicted by residuals that are so rarely so large.
CONTRADICTED = 0.001


def spread_directions(number: int) -> Array:
    """Unit vectors (number, 3) that are evenly spread over the sphere (Fibonacci's spiral)."""
    step = np.arange(number) + 0.5
    z = 1.0 - 2.0 * step / number
    azimuth = math.pi * (1.0 + math.sqrt(5.0)) * step
    across = np.sqrt(1.0 - z**2)
    return np.stack([across * np.cos(azimuth), across * np.sin(azimuth), z], axis=1)


U = spread_directions(DIRECTIONS)


@dataclass(frozen=True, eq=False)
class TouchRows:
    """The equations e_i = rows_i [delta, others] + noise of all touches."""

    rows: (
        Array  #: (n, 3, m): the first ``size`` columns are of the error delta, the others of what nobody knows besides
    )
    size: int  #: Numbers of delta: 6, or 7 with a scale
    errors_m: Array  #: (n, 3): predicted less known points
    sight: Array  #: (n, 3): unit vectors along the lines of sight


def error_rows(points_m: Array, centre_m: Array, lever_m: float, *, has_scale: bool) -> Array:
    """J (n, 3, 6 or 7) of points; rotations are about ``centre_m``, and in units of 1 / ``lever_m``."""
    levers = (points_m - centre_m) / lever_m
    turned = -np.array([se3.hat(lever) for lever in levers]).reshape(-1, 3, 3)
    blocks = [turned, np.broadcast_to(np.eye(3), (len(levers), 3, 3))]
    return np.concatenate([*blocks, levers[:, :, None]] if has_scale else blocks, axis=2)


@dataclass(frozen=True, eq=False)
class ErrorFit:
    """The estimated error, and its covariance: a sum over components of the noise, across the line of sight and along.

    Noise that is stated, or that counts as the same in all directions, is one component.
    """

    estimate: Array  #: (k,)
    parts: Array  #: (c, k, k): covariance for each component, of variance 1
    variances: Array  #: (c,): m^2; 1 where the noise is stated, and ``parts`` have it
    freedoms: Array  #: (c,): degrees of freedom of each; infinite where the noise is stated
    widths: Array  #: (c,): how many numbers of one touch each component has
    noise_m: tuple[float, float]  #: Standard deviations along each axis across the line of sight, and along it
    information: Array  #: (k, k): of all touches, for noise of variance 1 m^2
    count: int
    free: Array  #: (k, q): directions of delta that the touches leave free
    residuals_m: Array  #: (n, 3)
    is_contradicted: bool = False  #: Whether stated noise is too small for the residuals, so that it was estimated

    @property
    def is_estimated(self) -> bool:
        """Whether the noise is that of the residuals."""
        return bool(np.isfinite(self.freedoms).all())

    @property
    def mean_variance_m2(self) -> float:
        """Of the noise along all axes."""
        return (2.0 * self.noise_m[0] ** 2 + self.noise_m[1] ** 2) / 3.0

    def after(self, touches: int) -> ErrorFit:
        """The same estimate after so many touches of the same kind."""
        more = touches - self.count
        return replace(
            self, parts=self.parts * self.count / touches, freedoms=self.freedoms + more * self.widths, count=touches
        )


def fit_error(touches: TouchRows, noise_m: tuple[float, float] | None = None) -> ErrorFit:
    """Estimate the error by least squares, and the touches' noise from the residuals unless it is stated.

    Parameters
    ----------
    touches : TouchRows
    noise_m : (across, along), optional
        Standard deviation along each axis across the line of sight, and along it, metres.
    """
    rows, e, d = touches.rows, touches.errors_m, touches.sight
    n, _, m = rows.shape
    along = d[:, :, None] * d[:, None, :]
    across = np.eye(3) - along
    W = np.eye(3) if noise_m is None else across / noise_m[0] + along / noise_m[1]
    D = (W @ rows).reshape(3 * n, m)
    _, s, Vt = np.linalg.svd(np.vstack([D, np.zeros((max(m - 3 * n, 0), m))]), full_matrices=False)
    kept = s > NULL * s[0]
    V = Vt[kept].T / s[kept]
    G = V @ V.T
    x = G @ (D.T @ (W @ e[:, :, None]).ravel())
    residuals = e - rows @ x
    k, freedom = touches.size, 3.0 * n - kept.sum()
    free = Vt[~kept].T[:k]
    fit = ErrorFit(
        estimate=x[:k], parts=G[None, :k, :k], variances=np.ones(1), freedoms=np.array([math.inf]),
        widths=np.array([3.0]), noise_m=noise_m or (0.0, 0.0), information=_information(rows, k), count=n,
        free=free[:, np.linalg.norm(free, axis=0) > math.sqrt(NULL)], residuals_m=residuals,
    )  # fmt: skip
    if noise_m is not None:
        square = float(((W @ residuals[:, :, None]) ** 2).sum())
        if freedom < 1.0 or chdtrc(freedom, square) > CONTRADICTED:
            return fit
        return replace(fit_error(touches), is_contradicted=True)
    if freedom < 1.0:
        return replace(fit, freedoms=np.zeros(1), free=np.eye(k))
    pooled = float((residuals**2).sum()) / freedom
    alike = (math.sqrt(pooled), math.sqrt(pooled))
    fit = replace(fit, variances=np.array([pooled]), freedoms=np.array([freedom]), noise_m=alike)
    # E r'Q_k r = sum_j T_kj s_j for the projections Q_k on the components, with r = P e and P = 1 - D G D'.
    S = [np.einsum("nia,nij,njb->ab", rows, Q, rows) for Q in (across, along)]
    GS, numbers = [G @ one for one in S], np.array([2.0, 1.0]) * n
    traces = np.array([np.trace(one) for one in GS])
    freedoms = numbers - traces
    if freedom < SEPARATE or freedoms.min() < 1.0:
        return fit
    T = np.diag(numbers - 2.0 * traces) + np.array([[np.trace(one @ other) for other in GS] for one in GS])
    squares = [float(np.einsum("ni,nij,nj->", residuals, Q, residuals)) for Q in (across, along)]
    variances = np.maximum(np.linalg.solve(T, squares), LEAST_SHARE * pooled)
    parts = np.array([G @ one @ G for one in S])[:, :k, :k]
    noise = (math.sqrt(variances[0]), math.sqrt(variances[1]))
    return replace(fit, parts=parts, variances=variances, freedoms=freedoms, widths=np.array([2.0, 1.0]), noise_m=noise)


def _information(rows: Array, size: int) -> Array:
    """What all rows tell of their first ``size`` unknowns, where nobody knows the others (the Schur complement)."""
    N = np.einsum("nia,nib->ab", rows, rows)
    others = N[size:, size:]
    return np.asarray(N[:size, :size] - N[:size, size:] @ np.linalg.pinv(others) @ N[size:, :size])


@dataclass(frozen=True)
class Bound:
    """A bound on the error in a volume, and where it is attained."""

    value_m: float
    corner: int  #: Index of the point


def _deviations(fit: ErrorFit, C: Array, u: Array) -> tuple[Array, Array]:
    """Standard deviations (v, j) of u'J d for directions u (v, j, 3), and Satterthwaite's degrees of freedom."""
    shares = fit.variances[:, None, None] * np.einsum("vja,cvab,vjb->cvj", u, C, u)
    whole = shares.sum(axis=0)
    with np.errstate(divide="ignore", invalid="ignore"):
        freedoms = whole**2 / (shares**2 / fit.freedoms[:, None, None]).sum(axis=0)
    return np.sqrt(whole), np.where(np.isnan(freedoms), math.inf, freedoms)


def _student(level: float, freedoms: Array) -> Array:
    return np.where(freedoms > 1e6, ndtri(level), stdtrit(np.minimum(freedoms, 1e6), level))


def upper_bound(fit: ErrorFit, corners: Array, level: float, chance: float = 0.5) -> Bound:
    """The error at every corner (V, 3, k) is below this with probability ``level``, as the intersection-union test has.

    With a ``chance``, the value that the bound will not exceed with this chance if the estimate is the true error.
    """
    theta, C = corners @ fit.estimate, corners @ fit.parts[:, None] @ np.swapaxes(corners, 1, 2)

    def values(u: Array) -> tuple[Array, Array, Array]:
        deviations, freedoms = _deviations(fit, C, u)
        reach = _student(level, freedoms) + ndtri(chance)
        return np.einsum("vja,va->vj", u, theta) + reach * deviations, deviations, reach

    u = np.broadcast_to(U, (len(theta), DIRECTIONS, 3))
    found = values(u)[0]
    u = np.take_along_axis(u, found.argmax(axis=1)[:, None, None], axis=1)
    best = found.max(axis=1)
    Cov = np.einsum("c,cvab->vab", fit.variances, C)
    for _ in range(STEPS):  # a convex function of u: each step along its gradient climbs
        at, deviations, reach = values(u)
        best = np.maximum(best, at[:, 0])
        gradient = theta + (reach / np.maximum(deviations, 1e-300)) * (Cov @ u[:, 0, :, None])[:, :, 0]
        lengths = np.linalg.norm(gradient, axis=1, keepdims=True)
        u = np.where(lengths > 0.0, gradient / np.maximum(lengths, 1e-300), u[:, 0])[:, None]
    return Bound(float(best.max()), int(best.argmax()))


def lower_bound(fit: ErrorFit, corners: Array, level: float) -> float:
    """The largest error of all corners is above this with probability ``level``; 0 where nothing says that."""
    theta, C = corners @ fit.estimate, corners @ fit.parts[:, None] @ np.swapaxes(corners, 1, 2)
    lengths = np.maximum(np.linalg.norm(theta, axis=1), 1e-300)
    own = (theta / lengths[:, None])[:, None]
    u = np.concatenate([np.broadcast_to(U, (len(theta), DIRECTIONS, 3)), own], axis=1)
    deviations, freedoms = _deviations(fit, C, u)
    k = len(fit.estimate)
    reach = np.sqrt(k * fdtri(k, np.clip(freedoms, 1.0, 1e6), level))
    return max(0.0, float((np.einsum("vja,va->vj", u, theta) - reach * deviations).max()))


def largest_error(fit: ErrorFit, corners: Array) -> float:
    """The largest estimated error of all corners, metres."""
    return float(np.linalg.norm(corners @ fit.estimate, axis=1).max())


def amplification(fit: ErrorFit, corners: Array) -> float:
    """How many times worse the worst corner is known than the mean of all touches; infinite if it is not at all."""
    if np.linalg.norm(corners @ fit.free, axis=1).max(initial=0.0) > math.sqrt(NULL):
        return math.inf
    covariance = np.einsum("c,cab->ab", fit.variances, fit.parts)
    worst = np.linalg.eigvalsh(corners @ covariance @ np.swapaxes(corners, 1, 2))[:, -1].max()
    return math.sqrt(fit.count * worst / fit.mean_variance_m2) if worst > 0.0 else 1.0


def touches_needed(fit: ErrorFit, corners: Array, limit_m: float, level: float) -> int | None:
    """How many more touches of the same kind the acceptance needs, if the estimate is the true error.

    After them the calibration is accepted with the chance ``CHANCE``. None where the estimate is above the limit, or
    where ``MOST_TOUCHES`` are not enough.
    """

    def enough(touches: int) -> bool:
        return upper_bound(fit.after(touches), corners, level, CHANCE).value_m < limit_m

    return _least(enough, fit.count + 1, fit.count + MOST_TOUCHES, fit.count)


def _least(holds: Callable[[int], bool], low: int, high: int, base: int) -> int | None:
    """The least number from ``low`` to ``high`` for which ``holds``, less ``base``, by doubling and halving."""
    step = 1
    while not holds(min(base + step, high)):
        if base + step >= high:
            return None
        low, step = base + step + 1, 2 * step
    high = min(base + step, high)
    while low < high:
        middle = (low + high) // 2
        low, high = (low, middle) if holds(middle) else (middle + 1, high)
    return high - base


def best_places(fit: ErrorFit, corners: Array, number: int) -> list[int]:
    """The corners at which more touches tell most of the worst corner, one after the other (G-optimal exchange)."""
    every = max(1, len(corners) // MOST_PLACES)
    tried = corners[::every]
    size = np.eye(len(fit.information)) * 1e-9 * max(float(np.trace(fit.information)), 1.0)  # of what nothing tells yet
    information, chosen = fit.information + size, []
    for _ in range(number):
        trials = information + np.swapaxes(tried, 1, 2) @ tried
        spread = tried @ np.linalg.inv(trials)[:, None] @ np.swapaxes(tried, 1, 2)
        worst = np.linalg.eigvalsh(spread)[..., -1].max(axis=1)
        chosen.append(int(worst.argmin()))
        information = trials[chosen[-1]]
    return [every * each for each in chosen]
