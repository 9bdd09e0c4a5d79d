"""The cost of an answer as it is documented, from the measurements as they were given: enclosed, and exact.

Both documented forms are linear in a vector z of an answer (rotations row by row, shifted translations, scales, 1), so
a residual is a sum of products of doubles that are given with numbers of the answer. ``StatedCost.enclosed`` sums them
in pairs of doubles with a bound on the error. ``exact_cost`` has the same formula in fractions, and shares nothing with
this.

direct:   alpha (R_A t_X + t_A - t_Y) - R_Y t_B           R_A R_X - R_Y R_B
inverse:  R_Y'(t_Y - t_A - R_A c) + t_B / alpha - R_B R_X'(t_X - c)      R_B R_X' - R_Y' R_A
priors:   R - R_0, t - t_0
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import double_double as dd
import numpy as np
from double_double import Pairs

Array = np.ndarray
#: Below this, products of doubles lose digits to underflow; added once for each term.
UNDERFLOW = 1e-290


@dataclass(frozen=True)
class Rows:
    """Measurements of all pairs of a problem, one after another, as they were given, and the problem's knowledge."""

    frames: tuple[str, ...]
    R_A: Array  #: (N, 3, 3)
    t_A: Array  #: (N, 3)
    R_B: Array
    t_B: Array
    sigma: Array  #: (N,)
    kappa: Array
    X: Array  #: (N,) indices of frames
    Y: Array
    owner: Array  #: (N,) indices of scales
    owners: tuple[str, ...]
    known_scales: dict[str, float]  #: of ``owners``
    shares_scale: bool  #: whether all owners have one scale
    fixed: dict[str, Array]
    priors: tuple[tuple[str, Array, float | None, float | None], ...]

    @property
    def free(self) -> list[int]:
        return [i for i, name in enumerate(self.frames) if name not in self.fixed]

    @property
    def free_scales(self) -> list[str]:
        """One name for each unknown scale."""
        unknown = [name for name in self.owners if name not in self.known_scales]
        return unknown[:1] if self.shares_scale else unknown


@dataclass(frozen=True)
class Poses:
    """An answer in doubles: R (F, 3, 3), t (F, 3) of all frames, alpha by owner of a scale."""

    R: Array
    t: Array
    alpha: dict[str, float]

    @staticmethod
    def of(rows: Rows, matrices: Mapping[str, Array], scale: float | Mapping[str, float]) -> Poses:
        stacked = np.array([matrices[name] for name in rows.frames])
        alpha = {
            name: rows.known_scales[name]
            if name in rows.known_scales
            else float(scale[name])
            if isinstance(scale, Mapping)
            else float(scale)
            for name in rows.owners
        }
        return Poses(stacked[:, :3, :3], stacked[:, :3, 3], alpha)


@dataclass(frozen=True)
class Enclosure:
    """Values hi + lo (K,) that are off by at most ``error`` (K,)."""

    value: Pairs
    error: Array

    def is_below(self, number: float) -> Array:
        """Whether the value is proven to be below a double."""
        return dd.added(self.value, Pairs.of(-number)).hi < -self.error

    def is_above(self, number: float) -> Array:
        return dd.added(self.value, Pairs.of(-number)).hi > self.error


class StatedCost:
    """The cost of a problem in one of its forms.

    ``origins`` (F, 3) are doubles about which translations are variables; in the inverse form the origin of a frame in
    the role of X must be the one that the form names (``centre`` (F, 3), NaN elsewhere).
    """

    def __init__(self, rows: Rows, form: str, origins: Array, centre: Array) -> None:
        self.rows, self.form = rows, form
        self.is_inverse = form == "inverse"
        self.centre = centre
        self.origins = np.where(np.isfinite(centre), centre, origins) if self.is_inverse else origins
        count = len(rows.frames)
        self.one = 12 * count + len(rows.owners)
        self.size = self.one + 1
        self.scale_at = self._scale_columns()
        coefficients, index = self._terms()
        self.coefficients, self.index = coefficients, index
        self.weight = self._weights()
        self.spread = self._spread()

    # -- variables ----------------------------------------------------------------------------------------------

    def _scale_columns(self) -> Array:
        """The column of z of each owner's scale: alpha (direct) or 1 / alpha (inverse)."""
        base = 12 * len(self.rows.frames)
        if self.rows.shares_scale:
            return np.full(len(self.rows.owners), base)
        if not self.is_inverse:  # all known, and 1
            return np.full(len(self.rows.owners), self.one)
        return base + np.arange(len(self.rows.owners))

    def z_of(self, poses: Poses) -> tuple[Pairs, Pairs]:
        """z (1, size) and t (1, F, 3) of an answer in doubles, in pairs."""
        rows, count = self.rows, len(self.rows.frames)
        hi, lo = np.zeros((1, self.size)), np.zeros((1, self.size))
        hi[0, self.one] = 1.0
        shift = Pairs(*dd.two_sum(poses.t, -self.origins))
        if self.is_inverse:
            turned = _turned_back(Pairs.of(poses.R), shift)
            scale = {name: dd.reciprocal(Pairs.of(value)) for name, value in poses.alpha.items()}
        else:
            alpha = poses.alpha[rows.owners[0]] if rows.shares_scale else 1.0
            turned = dd.multiplied(shift, Pairs.of(alpha))
            scale = {name: Pairs.of(value) for name, value in poses.alpha.items()}
        blocks_hi, blocks_lo = hi[0, : 12 * count].reshape(count, 12), lo[0, : 12 * count].reshape(count, 12)
        blocks_hi[:, :9] = poses.R.reshape(count, 9)
        blocks_hi[:, 9:], blocks_lo[:, 9:] = turned.hi, turned.lo
        for column, name in zip(self.scale_at, rows.owners, strict=True):
            if column != self.one:
                hi[0, column], lo[0, column] = scale[name].hi, scale[name].lo
        return Pairs(hi, lo), Pairs.of(poses.t[None])

    # -- coefficients -------------------------------------------------------------------------------------------

    def _terms(self) -> tuple[Array, Array]:
        """Coefficients (m, w) and columns of z (m, w) of the residuals; priors of translations are not among them."""
        rows = self.rows
        n = len(rows.sigma)
        X, Y = 12 * rows.X[:, None, None], 12 * rows.Y[:, None, None]
        i, k = np.arange(3)[None, :, None], np.arange(3)[None, None, :]
        scale = np.broadcast_to(self.scale_at[rows.owner][:, None, None], (n, 3, 1))
        ones = np.ones((n, 3, 1))
        zero = np.zeros((n, 3, 1), dtype=int)
        if self.is_inverse:
            rest = self._rest()
            parts = [
                (-rows.R_B, X + 9 + k + 0 * i),
                (ones, Y + 9 + i),
                (rows.t_B[:, :, None], scale),
                (np.broadcast_to(rest.hi[:, None, :], (n, 3, 3)), Y + 3 * k + i),
                (np.broadcast_to(rest.lo[:, None, :], (n, 3, 3)), Y + 3 * k + i),
            ]
        else:
            rest = self._rest()
            parts = [
                (rows.R_A, X + 9 + k + 0 * i),
                (-ones, Y + 9 + i),
                (rest.hi[:, :, None], scale),
                (rest.lo[:, :, None], scale),
                (-np.broadcast_to(rows.t_B[:, None, :], (n, 3, 3)), Y + 3 * i + k),
            ]
        coefficients = np.concatenate([c for c, _ in parts], axis=2)
        index = np.concatenate([np.broadcast_to(j, c.shape) + zero for c, j in parts], axis=2)
        width = coefficients.shape[2]
        # Rotations: (n, 3, 3, 6) over i, j, then k of both products.
        X, Y = X[..., None], Y[..., None]
        i, j, k = np.ogrid[:3, :3, :3]
        i, j, k = i[None], j[None], k[None]
        if self.is_inverse:
            first, at_first = rows.R_B[:, :, None, :], X + 3 * j + k + 0 * i
            second, at_second = -rows.R_A.transpose(0, 2, 1)[:, None, :, :], Y + 3 * k + i + 0 * j
        else:
            first, at_first = rows.R_A[:, :, None, :], X + 3 * k + j + 0 * i
            second, at_second = -rows.R_B.transpose(0, 2, 1)[:, None, :, :], Y + 3 * i + k + 0 * j
        shape = (n, 3, 3, 3)
        turn = np.concatenate([np.broadcast_to(first, shape), np.broadcast_to(second, shape)], axis=3).reshape(-1, 6)
        at = np.concatenate([np.broadcast_to(at_first, shape), np.broadcast_to(at_second, shape)], axis=3)
        prior = [p for p in rows.priors if p[3] is not None]
        of_priors, at_priors = np.zeros((9 * len(prior), 2)), np.zeros((9 * len(prior), 2), dtype=int)
        for number, (name, T, _, _) in enumerate(prior):
            part = slice(9 * number, 9 * number + 9)
            of_priors[part, 0], of_priors[part, 1] = 1.0, -T[:3, :3].ravel()
            at_priors[part, 0] = 12 * rows.frames.index(name) + np.arange(9)
            at_priors[part, 1] = self.one
        blocks = [
            (coefficients.reshape(-1, width), index.reshape(-1, width)),
            (turn, at.reshape(-1, 6)),
            (of_priors, at_priors),
        ]
        total = sum(len(c) for c, _ in blocks)
        all_c, all_i = np.zeros((total, width)), np.zeros((total, width), dtype=int)
        first_row = 0
        for c, index_of in blocks:
            all_c[first_row : first_row + len(c), : c.shape[1]] = c
            all_i[first_row : first_row + len(c), : c.shape[1]] = index_of
            first_row += len(c)
        return all_c, all_i

    def _rest(self) -> Pairs:
        """(N, 3): R_A o_X + t_A - o_Y (direct), o_Y - t_A - R_A c (inverse)."""
        rows = self.rows
        o_X, o_Y = self.origins[rows.X], self.origins[rows.Y]
        terms = np.concatenate([rows.R_A, rows.t_A[:, :, None], o_Y[:, :, None]], axis=2)
        factors = np.ones_like(terms)
        factors[:, :, :3], factors[:, :, 4] = o_X[:, None, :], -1.0
        total = dd.dot(terms, Pairs.of(factors))
        return dd.negative(total) if self.is_inverse else total

    def _weights(self) -> Pairs:
        """(m,) 1 / sigma^2 and kappa, in pairs."""
        rows = self.rows
        inverse_squares = dd.reciprocal(Pairs(*dd.two_product(rows.sigma, rows.sigma)))
        prior = np.array([kappa for *_, kappa in rows.priors if kappa is not None])
        kappa = np.concatenate([np.repeat(rows.kappa, 9), np.repeat(prior, 9)])
        return Pairs(
            np.concatenate([np.repeat(inverse_squares.hi, 3), kappa]),
            np.concatenate([np.repeat(inverse_squares.lo, 3), np.zeros(len(kappa))]),
        )

    def _spread(self) -> Array:
        """(m,) magnitudes that were rounded when ``_rest`` was made."""
        rows = self.rows
        o_X, o_Y = np.abs(self.origins[rows.X]), np.abs(self.origins[rows.Y])
        size = np.einsum("nij,nj->ni", np.abs(rows.R_A), o_X) + np.abs(rows.t_A) + o_Y
        if self.is_inverse:
            size = np.repeat(size.sum(axis=1), 3).reshape(-1, 3)
        result = np.zeros(len(self.coefficients))
        result[: size.size] = size.ravel()
        return result

    # -- values -------------------------------------------------------------------------------------------------

    def residuals(self, z: Pairs, t: Pairs) -> tuple[Pairs, Array, Pairs, Pairs]:
        """Residuals (K, m), bounds on their errors, and weights and residuals (K, p) of priors of translations."""
        gathered = z.at((slice(None), self.index))
        products, errors = dd.two_product(self.coefficients, gathered.hi)
        r = dd.summed(products, errors + self.coefficients * gathered.lo)
        scale = 1.0 if self.is_inverse or self.scale_at[0] == self.one else np.abs(z.hi[:, self.scale_at[0], None])
        magnitude = np.abs(products).sum(axis=2) + self.spread * scale
        weights, residuals_hi, residuals_lo = [], [], []
        for name, T, sigma, _ in self.rows.priors:
            if sigma is not None:
                apart = dd.added(t.at((slice(None), self.rows.frames.index(name))), Pairs.of(-T[:3, 3]))
                residuals_hi.append(apart.hi)
                residuals_lo.append(apart.lo)
                weights += [sigma] * 3
        K = len(z.hi)
        squared = np.array(weights)
        of_priors = Pairs(
            np.concatenate([np.zeros((K, 0)), *residuals_hi], axis=1),
            np.concatenate([np.zeros((K, 0)), *residuals_lo], axis=1),
        )
        return r, magnitude, dd.reciprocal(Pairs(*dd.two_product(squared, squared))), of_priors

    def enclosed(self, z: Pairs, t: Pairs) -> tuple[Enclosure, Array]:
        """J (K,) with a bound on the error, and the residuals (K, m + p) in long double."""
        r, magnitude, prior_weight, of_priors = self.residuals(z, t)
        t_size = np.abs(t.hi).max(axis=(1, 2), initial=0.0)[:, None] + np.abs(self.origins).max(initial=0.0)
        for name, T, sigma, _ in self.rows.priors:
            if sigma is not None:
                t_size = t_size + np.abs(T[:3, 3]).max() + 0.0 * t_size if name else t_size
        magnitude = np.concatenate([magnitude, np.broadcast_to(t_size, of_priors.hi.shape)], axis=1)
        r = Pairs(*(np.concatenate([a, b], axis=1) for a, b in zip(r, of_priors, strict=True)))
        weight = Pairs(*(np.concatenate([a, b]) for a, b in zip(self.weight, prior_weight, strict=True)))
        square, low = dd.two_product(r.hi, r.hi)
        low = low + 2.0 * r.hi * r.lo
        term = dd.multiplied(weight, dd.normal(square, low))
        total = dd.summed(term.hi, term.lo)
        bound = (weight.hi * (np.abs(r.hi) + dd.UNIT * magnitude) * magnitude).sum(axis=1)
        error = dd.UNIT * (2.0 * bound + 2.0 * total.hi) + UNDERFLOW * weight.hi.sum()
        return Enclosure(Pairs(0.5 * total.hi, 0.5 * total.lo), error), r.long()

    def of_poses(self, poses: Poses) -> Enclosure:
        """J (1,) of an answer in doubles."""
        return self.enclosed(*self.z_of(poses))[0]

    def extent(self, poses: Poses, names: tuple[str, ...]) -> float:
        """The size of what was measured of some frames, in metres: how far targets are seen, and sensors from them."""
        rows = self.rows
        scale = np.array([poses.alpha[rows.owners[k]] for k in rows.owner])
        moved = np.einsum("nij,nj->ni", rows.R_A, poses.t[rows.X]) + rows.t_A - poses.t[rows.Y]
        reach = np.maximum(np.abs(rows.t_B).max(axis=1) / scale, np.abs(moved).max(axis=1))
        return float(reach[[rows.frames[x] in names for x in rows.X]].max())

    def sums(self, poses: Poses, target_carrier: Array, sensor_carrier: Array) -> float:
        """The squares that moments sum, about their reference points: what claims about moments are rounded by."""
        rows = self.rows
        front = np.where((rows.X == rows.Y)[:, None], sensor_carrier, target_carrier)
        t_A = np.einsum("nij,nj->ni", rows.R_A, front) + rows.t_A - sensor_carrier
        scale = np.array([poses.alpha[rows.owners[k]] for k in rows.owner])
        if self.is_inverse:
            t_B = rows.t_B / scale[:, None]
        else:
            t_A, t_B = scale[:, None] * t_A, rows.t_B
        reach = [t_A, t_B]
        for index, origin in ((rows.X, front), (rows.Y, sensor_carrier)):
            shift = poses.t[index] - origin
            reach.append(shift if self.is_inverse else scale[:, None] * shift)
        size = sum(np.linalg.norm(part, axis=1) for part in reach)
        # What shifting to the reference points rounds is far below this.
        size = size + 1e-6 * scale * sum(np.linalg.norm(part, axis=1) for part in (rows.t_A, front))
        return float((size**2 / rows.sigma**2).sum() + 12.0 * rows.kappa.sum())


def _turned_back(R: Pairs, v: Pairs) -> Pairs:
    """R' v for R (..., 3, 3) and v (..., 3)."""
    product = dd.multiplied(R, v.at((..., slice(None), None)))
    return dd.summed(product.hi, product.lo, axis=-2)
