"""Descent to answers that cost less than a bound by its last digits: residuals in pairs of doubles, exact rotations.

An answer is quaternions and linear unknowns in pairs of doubles, so it is a rotation exactly, and a rational one. Steps
are Newton's in whitened coordinates: the Jacobian, in long double, is orthonormalised in two passes, so directions that
the measurements hold by nothing but their rounding are followed as well as the others. That finds answers far away,
where the region allows them.
"""

from __future__ import annotations

from dataclasses import dataclass
from fractions import Fraction

import double_double as dd
import numpy as np
import quaternion_pairs as quaternions
from double_double import Pairs
from exact_cost import RationalPoses, fractions
from global_search import Columns, bending, tangents_of, weighted_matrix
from stated_cost import Enclosure, Poses, StatedCost

Array = np.ndarray
Long = np.longdouble
#: A direction whose singular value is below this share of the largest counts as weak: answers far along it are tried.
WEAK = 1e-7
#: Below this share a direction has no effect that long doubles can tell; it stays out of the steps.
NOTHING = 1e-18
#: Of the region's radius and factor: answers stay inside by this much.
INSIDE = 0.999


@dataclass(frozen=True)
class Region:
    """Where a bound holds: translations within a radius of an answer's, unknown scales within a factor."""

    t: Array  #: (F, 3) of all frames
    radius_m: float
    log_scales: Array  #: (s,) of the answer's unknown scales
    log_factor: float

    def holds(self, t: Array, log_scales: Array) -> Array:
        """Whether answers t (K, F, 3), log_scales (K, s) are inside."""
        distance = np.sqrt(((t - self.t) ** 2).sum(axis=2)).max(axis=1, initial=0.0)
        factor = np.abs(log_scales - self.log_scales).max(axis=1, initial=0.0)
        return (distance <= INSIDE * self.radius_m) & (factor <= INSIDE * self.log_factor)


@dataclass(frozen=True)
class Answers:
    """K answers: q (K, F, 4) and linear unknowns (K, l), both exact."""

    q: Pairs
    linear: Pairs

    def at(self, index: object) -> Answers:
        return Answers(self.q.at(index), self.linear.at(index))

    def where(self, mask: Array, other: Answers) -> Answers:
        """Those of ``other`` where the mask (K,) is true."""
        mine, theirs = (self.q, self.linear), (other.q, other.linear)
        chosen = [
            Pairs(*(np.where(mask.reshape(-1, *[1] * (a.ndim - 1)), b, a) for a, b in zip(x, y, strict=True)))
            for x, y in zip(mine, theirs, strict=True)
        ]
        return Answers(*chosen)

    @staticmethod
    def joined(answers: list[Answers]) -> Answers:
        q = Pairs(*(np.concatenate(parts) for parts in zip(*(a.q for a in answers), strict=True)))
        linear = Pairs(*(np.concatenate(parts) for parts in zip(*(a.linear for a in answers), strict=True)))
        return Answers(q, linear)


class PairDescent:
    """Descent of one stated cost from given answers."""

    def __init__(self, cost: StatedCost, returned: Poses, region: Region | None) -> None:
        self.cost, self.returned, self.region = cost, returned, region
        self.columns = Columns.of(cost)
        self.constant, self.constant_t = cost.z_of(returned)
        self.M = weighted_matrix(cost, Long)
        self.root = np.sqrt(cost.weight.long())
        self.prior_root = np.array([Long(1) / Long(s) for *_, s, _ in cost.rows.priors if s is not None]).repeat(3)
        self.prior_frames = [cost.rows.frames.index(name) for name, _, s, _ in cost.rows.priors if s is not None]

    # -- answers ------------------------------------------------------------------------------------------------

    def answers(self, poses: list[Poses]) -> Answers:
        free = self.cost.rows.free
        z = [self.cost.z_of(p)[0] for p in poses]
        return Answers(
            Pairs.of(np.array([quaternions.nearest(p.R[free]) for p in poses]).reshape(len(poses), len(free), 4)),
            Pairs(*(np.array([part[0, self.columns.linear] for part in parts]) for parts in zip(*z, strict=True))),
        )

    def z_and_t(self, answers: Answers) -> tuple[Pairs, Pairs]:
        K, free = len(answers.linear.hi), self.cost.rows.free
        hi, lo = (np.repeat(part, K, axis=0) for part in self.constant)
        t_hi, t_lo = (np.repeat(part, K, axis=0) for part in self.constant_t)
        R = quaternions.rotations(answers.q)
        for z, rotation, linear in ((hi, R.hi, answers.linear.hi), (lo, R.lo, answers.linear.lo)):
            z[:, self.columns.rotations] = rotation.reshape(K, len(free), 9)
            z[:, self.columns.linear] = linear
        if free:
            n = 3 * len(free)
            shift = Pairs(*(part[:, :n].reshape(K, -1, 3) for part in answers.linear))
            if self.cost.is_inverse:
                product = dd.multiplied(R, shift.at((..., None, slice(None))))
                moved = dd.summed(product.hi, product.lo)
            elif self.cost.rows.shares_scale:
                moved = dd.divided(shift, answers.linear.at((slice(None), slice(n, None), None)))
            else:
                moved = shift
            t = dd.added(moved, Pairs.of(self.cost.origins[free][None]))
            t_hi[:, free], t_lo[:, free] = t.hi, t.lo
        return Pairs(hi, lo), Pairs(t_hi, t_lo)

    def log_scales(self, answers: Answers) -> Array:
        scales = answers.linear.hi[:, self.columns.shifts.size :]
        with np.errstate(invalid="ignore", divide="ignore"):
            logs = np.log(scales)
        return -logs if self.cost.is_inverse else logs

    def rational(self, answers: Answers, k: int) -> RationalPoses:
        """Answer k in fractions."""
        rows, cost = self.cost.rows, self.cost
        exact = RationalPoses.of(self.returned)
        R, t, alpha = list(exact.R), list(exact.t), dict(exact.alpha)
        linear = [_fraction(answers.linear, (k, i)) for i in range(answers.linear.hi.shape[1])]
        size = self.columns.shifts.size
        for name, value in zip(rows.free_scales, linear[size:], strict=True):
            for owner in rows.owners if rows.shares_scale else (name,):
                alpha[owner] = 1 / value if cost.is_inverse else value
        for place, f in enumerate(rows.free):
            R[f] = np.array(quaternions.exactly([_fraction(answers.q, (k, place, i)) for i in range(4)]))
            shift = np.array(linear[3 * place : 3 * place + 3])
            if cost.is_inverse:
                shift = R[f] @ shift
            elif rows.shares_scale:
                shift = shift / alpha[rows.owners[0]]
            t[f] = fractions(cost.origins[f]) + shift
        return RationalPoses(R, t, alpha)

    def rounded(self, answers: Answers, k: int) -> Poses:
        """Answer k with every entry rounded to the nearest double."""
        z, t = self.z_and_t(answers.at(slice(k, k + 1)))
        count = len(self.cost.rows.frames)
        R = z.hi[0, : 12 * count].reshape(count, 12)[:, :9].reshape(count, 3, 3)
        rows, alpha = self.cost.rows, dict(self.returned.alpha)
        scales = answers.linear.hi[k, self.columns.shifts.size :].tolist()
        for name, value in zip(rows.free_scales, scales, strict=True):
            for owner in rows.owners if rows.shares_scale else (name,):
                alpha[owner] = 1.0 / value if self.cost.is_inverse else value
        return Poses(R, t.hi[0], alpha)

    def nudged(self, poses: Poses) -> Poses:
        """An answer with each entry of its rotations moved by an ulp, to where the cost falls."""
        _, r = self.cost.enclosed(*self.cost.z_of(poses))
        weighted = r * np.concatenate([self.root, self.prior_root])
        gradient = (weighted @ self.M).astype(float)[:, self.columns.rotations].reshape(-1, 3, 3)
        R, free = poses.R.copy(), self.cost.rows.free
        towards = np.where(gradient > 0.0, -np.inf, np.inf)
        R[free] = np.where(gradient == 0.0, R[free], np.nextafter(R[free], towards))
        return Poses(R, poses.t, poses.alpha)

    # -- descent ------------------------------------------------------------------------------------------------

    def enclosed(self, answers: Answers) -> Enclosure:
        return self.cost.enclosed(*self.z_and_t(answers))[0]

    def inside(self, answers: Answers, t: Array) -> Array:
        scales = self.log_scales(answers)
        fine = np.isfinite(scales).all(axis=1) & np.isfinite(t).all(axis=(1, 2))
        if self.region is not None:
            with np.errstate(invalid="ignore"):
                fine &= self.region.holds(t, scales)
        return fine

    def descend(self, answers: Answers, steps: int, *, holds_weak: bool = False) -> tuple[Answers, Enclosure]:
        """The answers after some Newton steps that lower the cost, inside the region."""
        K = len(answers.linear.hi)
        z, t = self.z_and_t(answers)
        value, r = self.cost.enclosed(z, t)
        damping = np.zeros(K)
        for _ in range(steps):
            step, weak = self._step(z, r, damping)
            if holds_weak:
                weak = np.zeros_like(weak)
            tried = self._moved(answers, step + weak)
            z_tried, t_tried = self.z_and_t(tried)
            out = ~self.inside(tried, t_tried.hi)
            if out.any() and weak[out].any():
                share = self._share_inside(t.hi, t_tried.hi, answers, tried)
                tried = tried.where(out, self._moved(answers, step + share[:, None] * weak))
                z_tried, t_tried = self.z_and_t(tried)
                out = ~self.inside(tried, t_tried.hi)
            value_tried, r_tried = self.cost.enclosed(z_tried, t_tried)
            fall = value.value.long() - value_tried.value.long()
            better = (fall > 0) & ~out
            if better.any():
                answers = answers.where(better, tried)
                z = Pairs(*(np.where(better[:, None], b, a) for a, b in zip(z, z_tried, strict=True)))
                t = Pairs(*(np.where(better[:, None, None], b, a) for a, b in zip(t, t_tried, strict=True)))
                r = np.where(better[:, None], r_tried, r)
                kept = [np.where(better, b, a) for a, b in zip(value.value, value_tried.value, strict=True)]
                value = Enclosure(Pairs(*kept), np.where(better, value_tried.error, value.error))
            damping = np.where(better, 0.1 * damping, np.maximum(10.0 * damping, 1e-2))
            if not (better & (fall > 1e-17 * value.value.hi)).any() and (damping > 1.0).all():
                break
            if (np.abs(fall) <= 1e-17 * value.value.hi).all():
                break
        return answers, value

    def _moved(self, answers: Answers, step: Array) -> Answers:
        K = len(step)
        free = len(self.cost.rows.free)
        omega = np.asarray(step[:, : 3 * free], dtype=float).reshape(K, free, 3)
        linear = step[:, 3 * free :]
        hi = linear.astype(float)
        lo = (linear - hi).astype(float)
        return Answers(
            quaternions.turned(answers.q, omega) if free else answers.q, dd.added(answers.linear, Pairs(hi, lo))
        )

    def _share_inside(self, t: Array, t_tried: Array, answers: Answers, tried: Answers) -> Array:
        """How much of a step along weak directions (K,) stays inside the region and keeps scales positive."""
        share = np.ones(len(t))
        if self.region is not None:
            length = np.sqrt(((t_tried - t) ** 2).sum(axis=2)).max(axis=1, initial=0.0)
            used = np.sqrt(((t - self.region.t) ** 2).sum(axis=2)).max(axis=1, initial=0.0)
            share = np.minimum(share, (INSIDE * self.region.radius_m - used) / np.maximum(length, 1e-300))
            factor = np.exp(INSIDE * self.region.log_factor)
        else:
            factor = 1e9
        size = self.columns.shifts.size
        before, after = answers.linear.hi[:, size:], tried.linear.hi[:, size:]
        change = after / before - 1.0
        limit = np.where(change > 0.0, factor - 1.0, 1.0 - 1.0 / factor) / np.maximum(np.abs(change), 1e-300)
        share = np.minimum(share, 0.99 * limit.min(axis=1, initial=np.inf))
        return np.clip(share, 0.0, 1.0)

    def jacobian(self, z: Pairs) -> Array:
        """(K, m, n) over the rotations' tangents and the linear unknowns, weighted."""
        K, free = len(z.hi), len(self.columns.rotations)
        R = z.long()[:, self.columns.rotations].reshape(K, free, 3, 3)
        tangents = tangents_of(R).reshape(K, free, 9, 3)
        J = np.empty((K, len(self.M), 3 * free + len(self.columns.linear)), dtype=Long)
        for f in range(free):
            J[:, :, 3 * f : 3 * f + 3] = self.M[:, self.columns.rotations[f]] @ tangents[:, f]
        J[:, :, 3 * free :] = self.M[:, self.columns.linear]
        return J

    def whitened(self, J: Array) -> tuple[Array, Array, Array]:
        """T (K, n, n) with J T orthonormal, J T, and the singular values' shares of the largest, by column of T."""
        norms = np.sqrt((J**2).sum(axis=1))
        norms[norms == 0] = 1
        scaled = J / norms[:, None, :]
        gram_root = np.linalg.qr(scaled.astype(float), mode="r")
        V = np.linalg.svd(gram_root)[2].transpose(0, 2, 1).astype(Long)
        W = scaled @ V
        sizes = np.sqrt((W**2).sum(axis=1))
        largest = sizes.max(axis=1, keepdims=True, initial=Long(1e-300))
        alive = sizes > NOTHING * largest
        factor = np.where(alive, 1 / np.where(alive, sizes, 1), 0)
        W = W * factor[:, None, :]
        near = W.astype(float)
        gram = near.transpose(0, 2, 1) @ near
        values, E = np.linalg.eigh(gram)
        good = values > 1e-9
        E = E * np.where(good, 1.0 / np.sqrt(np.where(good, values, 1.0)), 0.0)[:, None, :]
        T = (V * factor[:, None, :] / norms[:, :, None]) @ E.astype(Long)
        # Columns mix the sizes only among directions that are not orthogonal already; the share is the mixture's least.
        mixed = np.abs(E) > 1e-3 * np.abs(E).max(axis=1, keepdims=True, initial=1e-300)
        share = np.where(mixed, (sizes / largest).astype(float)[:, :, None], np.inf).min(axis=1)
        return T, W @ E.astype(Long), share

    def _step(self, z: Pairs, r: Array, damping: Array) -> tuple[Array, Array]:
        """Newton's step in strong and in weak directions, each (K, n) in long double."""
        K, free = len(z.hi), len(self.columns.rotations)
        m = len(self.root)
        weighted = r * np.concatenate([self.root, self.prior_root])
        if self.cost.is_inverse:
            for index, f in enumerate(self.prior_frames):
                part = slice(m + 3 * index, m + 3 * index + 3)
                R = z.long()[:, 12 * f : 12 * f + 9].reshape(K, 3, 3)
                weighted[:, part] = (R.transpose(0, 2, 1) @ weighted[:, part, None])[..., 0]
        J = self.jacobian(z)
        T, JT, share = self.whitened(J)
        gradient = (JT.transpose(0, 2, 1) @ weighted[..., None])[..., 0].astype(float)
        R = z.hi[:, self.columns.rotations].reshape(K, free, 3, 3)
        G = (weighted @ self.M).astype(float)[:, self.columns.rotations].reshape(K, free, 3, 3)
        bend = bending(R, G)
        T_R = T[:, : 3 * free].astype(float).reshape(K, free, 3, T.shape[2])
        H = np.eye(T.shape[2]) + (T_R.transpose(0, 1, 3, 2) @ bend @ T_R).sum(axis=1)
        values, E = np.linalg.eigh(H)
        along = np.einsum("kij,ki->kj", E, gradient) / (np.maximum(np.abs(values), 1e-8) + damping[:, None])
        y = -np.einsum("kij,kj->ki", E, along)
        is_weak = share < WEAK
        strong = (T @ np.where(is_weak, 0.0, y)[..., None])[..., 0]
        weak = (T @ np.where(is_weak, y, 0.0)[..., None])[..., 0]
        # Rotations by more than this leave the quadratic model.
        for part in (strong, weak):
            turn = np.abs(part[:, : 3 * free]).max(axis=1, initial=0)
            part *= (1 / np.maximum(turn / Long(0.5), 1))[:, None]
        return strong, weak

    def far(self, answers: Answers, k: int) -> Answers | None:
        """Answers far from answer k along weak directions: to the region's border, or to 10^12 m."""
        here = answers.at(slice(k, k + 1))
        z, t = self.z_and_t(here)
        J = self.jacobian(z)
        T, _, share = self.whitened(J)
        norms = np.sqrt((J**2).sum(axis=1))[0]
        norms[norms == 0] = 1
        _, s, Vt = np.linalg.svd(np.linalg.qr((J[0] / norms).astype(float), mode="r"))
        directions = [Vt[i] / norms for i in np.flatnonzero(s < WEAK * s.max(initial=0.0))]
        directions += [T[0, :, i] for i in np.flatnonzero((share[0] < WEAK) & (T[0] != 0).any(axis=0))]
        free = len(self.columns.rotations)
        result = []
        for v in directions[:6]:
            v = np.asarray(v, dtype=Long)
            length = np.abs(v[3 * free :]).max(initial=0)
            if not length > 0:
                continue
            if self.region is not None and np.isfinite(self.region.radius_m):
                distances = [0.995 * self.region.radius_m, 0.3 * self.region.radius_m]
            else:
                distances = [1e3, 1e6, 1e9, 1e12]
            for distance in distances:
                for sign in (1, -1):
                    step = (sign * distance / length) * v[None]
                    step[:, : 3 * free] = np.clip(step[:, : 3 * free], -1, 1)
                    tried = self._moved(here, step)
                    t_tried = self.z_and_t(tried)[1].hi
                    if not self.inside(tried, t_tried)[0]:
                        part = self._share_inside(t.hi, t_tried, here, tried)
                        tried = self._moved(here, part[:, None] * step)
                    if self.inside(tried, self.z_and_t(tried)[1].hi)[0]:
                        result.append(tried)
        return Answers.joined(result) if result else None


def _fraction(pairs: Pairs, index: tuple[int, ...]) -> Fraction:
    return Fraction(float(pairs.hi[index])) + Fraction(float(pairs.lo[index]))
