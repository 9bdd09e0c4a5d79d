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
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from rwhec_factors import se3
from scipy.special import chdtrc, fdtri, ndtri, stdtrit

from gtsam_rwhec.geometry.poses import Array

#: Singular values below this share of the largest are none: the touches leave their direction free.
NULL = 1e-6
#: The noise along the line of sight is estimated by itself from so many degrees of freedom of the residuals on.
SEPARATE = 6.0
#: It is taken as at least this share of the variance of both together: few residuals may show none by chance.
LEAST_SHARE = 0.1
#: Directions u that are tried at every corner, how many of the best climb on from there, and by how many steps.
DIRECTIONS, CLIMBERS, STEPS = 100, 8, 12
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
    blocks = [-se3.hat(levers), np.broadcast_to(np.eye(3), (len(levers), 3, 3))]
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
    count: int  #: Touches
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


def fit_error(touches: TouchRows, noise_m: tuple[float, float] | None = None) -> ErrorFit:
    """Estimate the error by least squares, and the touches' noise from the residuals unless it is stated.

    ``noise_m`` is the standard deviation along each axis across the line of sight, and along it, metres.
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


@dataclass(frozen=True, eq=False)
class VolumeTest:
    """The bounds on the error in a volume, whose corners move by ``corners`` (V, 3, k) times the error."""

    fit: ErrorFit
    corners: Array
    level: float  #: Probability of each bound

    @cached_property
    def _theta(self) -> Array:
        """The estimated error (V, 3) of every corner, metres."""
        return np.asarray(self.corners @ self.fit.estimate)

    @cached_property
    def _covariances(self) -> Array:
        """Covariances (c, V, 3, 3) of these by component of the noise, m^2."""
        parts = self.fit.variances[:, None, None] * self.fit.parts
        return np.asarray(self.corners @ parts[:, None] @ np.swapaxes(self.corners, 1, 2))

    @cached_property
    def _grid(self) -> tuple[Array, Array]:
        """u'J(p) d (V * j) of all corners p and directions u, and its variances (c, V * j)."""
        own = self._theta / np.maximum(np.linalg.norm(self._theta, axis=1, keepdims=True), 1e-300)
        along = np.concatenate([self._theta @ U.T, np.einsum("va,va->v", own, self._theta)[:, None]], axis=1)
        variances = np.einsum("ja,cvab,jb->cvj", U, self._covariances, U, optimize=True)
        of_own = np.einsum("va,cvab,vb->cv", own, self._covariances, own)
        return np.asarray(along.ravel()), np.concatenate([variances, of_own[:, :, None]], axis=2).reshape(
            len(variances), -1
        )

    @cached_property
    def estimate_m(self) -> float:
        """The largest estimated error of all corners, metres."""
        return float(np.linalg.norm(self._theta, axis=1).max())

    @cached_property
    def amplification(self) -> float:
        """How many times worse the worst corner is known than the mean of all touches; infinite if it is not at all."""
        if np.linalg.norm(self.corners @ self.fit.free, axis=1).max(initial=0.0) > math.sqrt(NULL):
            return math.inf
        worst = float(np.linalg.eigvalsh(self._covariances.sum(axis=0))[:, -1].max())
        return math.sqrt(self.fit.count * worst / self.fit.mean_variance_m2) if worst > 0.0 else 1.0

    def upper(self) -> tuple[float, int]:
        """The error everywhere in the volume is below this, metres; and the corner at which it is attained."""
        return self._climbed(*self._largest(self._student, 1.0, self.fit.freedoms))

    def lower_m(self) -> float:
        """The largest error in the volume is above this, metres; 0 where nothing says that."""
        k = self.corners.shape[2]

        def scheffe(freedoms: Array) -> Array:
            return np.asarray(np.sqrt(k * fdtri(k, np.minimum(freedoms, 1e6), self.level)))

        return max(0.0, float(self._largest(scheffe, -1.0, self.fit.freedoms)[0].max()))

    def needed(self, limit_m: float) -> int | None:
        """How many more touches of the same kind the acceptance needs, if the estimate is the true error.

        After them the calibration is accepted with the chance ``CHANCE``. None where the estimate is above the limit,
        or where ``MOST_TOUCHES`` are not enough.
        """
        n, fit = self.fit.count, self.fit

        def enough(more: int) -> bool:
            shrunk = math.sqrt(n / (n + more))
            return bool(
                self._largest(
                    lambda freedoms: shrunk * (self._student(freedoms) + ndtri(CHANCE)), 1.0,
                    fit.freedoms + more * fit.widths,
                )[0].max() < limit_m
            )  # fmt: skip

        low, high = 1, 1
        while not enough(high):
            if high >= MOST_TOUCHES:
                return None
            low, high = high + 1, min(2 * high, MOST_TOUCHES)
        while low < high:
            middle = (low + high) // 2
            low, high = (low, middle) if enough(middle) else (middle + 1, high)
        return high

    def _student(self, freedoms: Array) -> Array:
        return np.asarray(np.where(freedoms > 1e6, ndtri(self.level), stdtrit(np.minimum(freedoms, 1e6), self.level)))

    def _largest(self, reach: Reach, sign: float, freedoms: Array) -> tuple[Array, NDArray[np.intp]]:
        """The largest values of u'J(p) d + sign * reach * deviation on the grid, and where they are.

        The reach falls with the degrees of freedom, which are between the least of a component and all together; so
        most of the grid cannot have the largest value, and is left out.
        """
        along, variances = self._grid
        deviations = np.sqrt(variances.sum(axis=0))
        ends = reach(np.array([freedoms.min(), freedoms.sum()]))
        low, high = (along + sign * end * deviations for end in (ends if sign < 0.0 else ends[::-1]))
        kept = np.flatnonzero(high >= low.max())
        values = along[kept] + sign * reach(_satterthwaite(variances[:, kept], freedoms)) * deviations[kept]
        order = np.argsort(values)[::-1][:CLIMBERS]
        return np.asarray(values[order]), np.asarray(kept[order], dtype=np.intp)

    def _climbed(self, values: Array, at: NDArray[np.intp]) -> tuple[float, int]:
        """The maximum between the directions of the grid; each step along the gradient of a convex function climbs."""
        number = len(U) + 1
        corner = at // number
        theta, C = self._theta[corner], self._covariances[:, corner]
        own = theta / np.maximum(np.linalg.norm(theta, axis=1, keepdims=True), 1e-300)
        u = np.where((at % number < len(U))[:, None], U[np.minimum(at % number, len(U) - 1)], own)
        best = values
        for _ in range(STEPS):
            variances = np.einsum("va,cvab,vb->cv", u, C, u)
            deviations = np.sqrt(variances.sum(axis=0))
            reach = self._student(_satterthwaite(variances, self.fit.freedoms))
            best = np.maximum(best, np.einsum("va,va->v", u, theta) + reach * deviations)
            pull = np.einsum("cvab,vb->va", C, u) / np.maximum(deviations, 1e-300)[:, None]
            gradient = theta + reach[:, None] * pull
            lengths = np.linalg.norm(gradient, axis=1, keepdims=True)
            u = np.where(lengths > 0.0, gradient / np.maximum(lengths, 1e-300), u)
        return float(best.max()), int(corner[best.argmax()])


Reach = Callable[[Array], Array]


def _satterthwaite(variances: Array, freedoms: Array) -> Array:
    """Degrees of freedom of sums over the first axis of ``variances``, whose rows have these ``freedoms``."""
    whole = variances.sum(axis=0)
    shares = variances / np.maximum(whole, 1e-300)
    with np.errstate(divide="ignore"):
        return np.asarray(np.where(whole > 0.0, 1.0 / (shares**2 / freedoms[:, None]).sum(axis=0), freedoms.min()))


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
