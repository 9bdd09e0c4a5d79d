"""The cost of a part from its raw measurements as they were given, enclosed: what the certificate is about.

In both kinds a pair's residuals are those of a *front* pose F and a *back* pose K (design facts 1 and 7)::

    R_F R_1 - R_2 R_K,       R_F u + s t_F + one - R_2 (t_K + R_K c)

direct (A X = Y B): F = A, K = B, R_1 = R_X, R_2 = R_Y, u = alpha t_X, s = alpha, one = -alpha t_Y, c = 0.
inverse (B X' = Y' A): F = B, K = A, R_1 = R_X', R_2 = R_Y', u = t_X', s = 1 / scale, one = -t_Y' + R_Y' a, and c is the
gauge's point in the target carrier; A is taken about the gauge there, which the cost depends on.

They are linear in the variables and in the features of the measurements. The coefficients are made in twice the
precision, so that a distant origin costs no digits.
"""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import TypeAlias

import numpy as np

from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.geometry.rounding import Doubled, difference, gamma, product, reciprocal, turned
from gtsam_rwhec.problem.knowledge import Prior
from gtsam_rwhec.solver.answers import Action, Answer, Evaluation, Point, as_point
from gtsam_rwhec.solver.block_matrix import sum_into
from gtsam_rwhec.solver.full_form import ALPHA, SIDES, Slots, as_variable, rounding_of_fixed
from gtsam_rwhec.solver.parts import Given, Part
from gtsam_rwhec.solver.residual_sums import Coefficients, Measured, Sums, cost_sums, weighted_sums

#: An upper limit of the rounded operations of a prior after its residual, which is accurate to one rounding.
OPERATIONS = 40


#: Of one prior: residuals of translation (3, D) and of rotation (9, D), and magnitudes of their terms.
Rows: TypeAlias = tuple[Array, Array, Array, Array]


@dataclass(frozen=True)
class MeasuredPriors:
    """The priors of a part, about the user's origin."""

    part: Part
    priors: dict[str, list[Prior]]

    def at_poses(self, R: Array, t: Array) -> Evaluation:
        """The cost of frames R (n, 3, 3), t (n, 3) about the user's origin."""

        def off(i: int, prior: Prior) -> Array:
            t_0 = prior.transform[:3, 3]
            residual: Array = difference(t[i], t_0).value
            if self.part.kind == "inverse":
                residual = turned(R[None, i].transpose(0, 2, 1), _row(difference(t_0, t[i]))).value[0]
            return residual

        return self._evaluated(R if self.part.kind == "direct" else R.transpose(0, 2, 1), off)

    def at(self, point: Point) -> Evaluation:
        """The cost at values of the variables about the gauge."""
        R = point.rotations

        def off(i: int, prior: Prior) -> Array:
            t, about = Doubled.of(point.numbers[i, :3]), self._about_gauge(i, prior)
            residual: Array = t.minus(about).value
            if self.part.kind == "inverse":
                residual = turned(R[None, i], _row(about)).plus(_row(t)).value[0]
            return residual

        return self._evaluated(R, off)

    def action(self, point: Point, V: Array) -> Action:
        """The products of the priors' form with directions V (13 n + 1, D)."""
        of_frames, at_point = V[:-1].reshape(-1, 13, V.shape[1]), self.at(point)

        def rows(i: int, prior: Prior) -> Rows:
            t, r, about = of_frames[i, :3], of_frames[i, 4:], self._about_gauge(i, prior).value
            if self.part.kind == "direct":
                return t, r, np.abs(t), np.abs(r)
            # The magnitude of the terms that cancel.
            return t + _times(r, about), r, np.abs(t) + _times(np.abs(r), np.abs(about)), np.abs(r)

        VQx_error = np.abs(V).T @ (at_point.gradient_error + gamma(len(V)) * np.abs(at_point.gradient))
        return Action(*self._summed(rows, V.shape[1]), V.T @ at_point.gradient, VQx_error)

    def _each(self) -> Iterator[tuple[int, Prior]]:
        """Each prior of a free frame, with the frame's index."""
        return ((i, prior) for i, name in enumerate(self.part.free) for prior in self.priors.get(name, []))

    def _about_gauge(self, i: int, prior: Prior) -> Doubled:
        return difference(prior.transform[:3, 3], self.part.frame_shift(self.part.free[i]))

    def _evaluated(self, R: Array, off: Callable[[int, Prior], Array]) -> Evaluation:
        """The cost from the translation residual (3,) of each frame and prior; rotations as the form has them."""

        def rows(i: int, prior: Prior) -> Rows:
            turn = R[i] - as_variable(prior.transform, self.part)[:3, :3]
            t, r = off(i, prior)[:, None], turn.T.reshape(9, 1)  # column after column
            return t, r, np.abs(t), np.abs(r)

        gradient, gradient_error, cost, cost_error = self._summed(rows, 1)
        none = Point(np.zeros((0, 13)), 0.0)
        return Evaluation(none, float(cost[0, 0]), float(cost_error[0, 0]), gradient[:, 0], gradient_error[:, 0])

    def _summed(self, rows: Callable[[int, Prior], Rows], D: int) -> tuple[Array, Array, Array, Array]:
        """Sums of Q V (13 n + 1, D) and V'Q V (D, D) from each prior's rows, each with a bound on its error."""
        (QV, QV_size), (VQV, VQV_size) = np.zeros((2, 13 * len(self.part.free) + 1, D)), np.zeros((2, D, D))
        for i, prior in self._each():
            about = self._about_gauge(i, prior).value
            of_t, of_r, t_size, r_size = rows(i, prior)
            t_rows, r_rows = slice(13 * i, 13 * i + 3), slice(13 * i + 4, 13 * i + 13)
            for by, products, t, r, s in (
                (QV, VQV, of_t, of_r, about),
                (QV_size, VQV_size, t_size, r_size, np.abs(about)),
            ):
                if prior.sigma is not None:
                    by[t_rows] += 0.5 / prior.sigma**2 * t
                    products += 0.5 / prior.sigma**2 * t.T @ t
                    if self.part.kind == "inverse":
                        by[r_rows] += 0.5 / prior.sigma**2 * np.kron(s[:, None], t)
                if prior.kappa is not None:
                    by[r_rows] += 0.5 * prior.kappa * r
                    products += 0.5 * prior.kappa * r.T @ r
        unit = gamma(OPERATIONS + len(self.priors) + sum(map(len, self.priors.values())))
        return QV, unit * QV_size, VQV, unit * VQV_size


def _row(v: Doubled) -> Doubled:
    """One vector as a stack of one."""
    return Doubled(v.hi[None], v.lo[None])


def _times(r: Array, v: Array) -> Array:
    """R v for vec R (9, D) of directions, column after column: (3, D)."""
    result: Array = np.einsum("kpd,k->pd", r.reshape(3, 3, -1), v)
    return result


#: This many pairs are evaluated at once: their coefficients and sums take 15 kB for each pair.
PAIRS_AT_ONCE = 2048


@dataclass(frozen=True)
class _Ends:
    """Coefficients of E pairs in D directions: R_1, R_2 (E, D, 3, 3), u, one (E, D, 3), s (E, D)."""

    R_1: Array
    R_2: Array
    u: Doubled
    s: Doubled
    one: Doubled


@dataclass(frozen=True)
class _Measured(Evaluation):
    """An evaluation, and the coefficients from which it was computed."""

    ends: Callable[[slice], _Ends] | None = None


@dataclass(frozen=True)
class MeasuredForm:
    """The cost of a part; ``given`` are its measurements."""

    part: Part
    given: Given
    slots: Slots

    @cached_property
    def _priors(self) -> MeasuredPriors:
        return MeasuredPriors(self.part, self.given.priors)

    @cached_property
    def _centres(self) -> tuple[Array, Array]:
        """The gauge's points a and c (E, 3): a motion has both ends in the sensor's carrier."""
        gauge = self.part.gauge
        a = np.broadcast_to(gauge.sensor_carrier, (len(self.part.pairs), 3))
        c = np.where(self.part.moments.motion[:, None], gauge.sensor_carrier, gauge.target_carrier)
        return a, c

    @cached_property
    def _of_fixed(self) -> Array:
        return rounding_of_fixed(self.part)

    def at_poses(self, R: Array, t: Array, answer: Answer) -> Evaluation:
        """The cost of poses as they are returned: R (n, 3, 3), t (n, 3) about the user's origin, and their scales."""
        fixed = np.array([self.given.fixed[name] for name in self.part.fixed]).reshape(-1, 4, 4)
        of_frames = np.concatenate([R, fixed[:, :3, :3]]), np.concatenate([t, fixed[:, :3, 3]])

        def ends(at: slice) -> _Ends:
            return self._of_poses(*of_frames, answer, at)

        return self._evaluated(as_point(self.part, answer), ends, self._priors.at_poses(R, t))

    def at(self, point: Point) -> Evaluation:
        """The cost at values of the variables about the gauge."""
        return self._evaluated(point, self._of_point(point), self._priors.at(point))

    def _blocks(self) -> Iterator[slice]:
        """Slices of the pairs, short enough that the arrays computed from one slice fit in memory."""
        return (slice(begin, begin + PAIRS_AT_ONCE) for begin in range(0, len(self.part.pairs), PAIRS_AT_ONCE))

    def action(self, evaluation: Evaluation, V: Array) -> Action:
        """The form's products with directions."""
        D = V.shape[1]
        point = evaluation.point
        ends = evaluation.ends if isinstance(evaluation, _Measured) else None
        if ends is None:
            ends = self._of_point(point)
        QV, QV_error = np.zeros((2, *V.shape))
        products, error = np.zeros((2, D + 1, D + 1))
        for at in self._blocks():
            sums = weighted_sums(*self._coefficients(self._joined(self._of_directions(V, 0.0, at), ends(at)), at))
            for whole, of_block in zip((QV, QV_error), self._by_variables(sums, range(D), at), strict=True):
                whole += of_block
            products += 0.5 * sums.products.sum(axis=(0, 3))
            error += 0.5 * sums.products_error.sum(axis=(0, 3))
            error += gamma(len(self.part.pairs) + 16) * 0.5 * np.abs(sums.products).sum(axis=(0, 3))
        error *= 1.0 + 1e-9
        of_priors = self._priors.action(point, V)
        return Action(
            QV + of_priors.QV,
            QV_error + of_priors.QV_error + gamma(2) * np.abs(QV),
            products[:D, :D] + of_priors.VQV,
            error[:D, :D] + of_priors.VQV_error + gamma(2) * np.abs(products[:D, :D]),
            products[:D, D] + of_priors.VQx,
            error[:D, D] + of_priors.VQx_error + gamma(2) * np.abs(products[:D, D]),
        )

    # -- coefficients -------------------------------------------------------------------------------------------

    def _of_poses(self, R: Array, t: Array, answer: Answer, at: slice) -> _Ends:
        """The coefficients of some pairs at poses about the user's origin, of free frames and then of fixed ones."""
        part, c = self.part, self._centres[1][at]
        target, sensor = part.ends[at].T
        R_X, t_X, R_Y, t_Y = R[target], t[target], R[sensor], t[sensor]
        E = len(target)
        if part.kind == "direct":
            alpha = np.full((E, 1), answer.scale if part.scale == "shared" else 1.0)
            one = product(alpha, t_Y)
            return _stacked(R_X, R_Y, product(alpha, t_X), Doubled.of(alpha[:, 0]), Doubled(-one.hi, -one.lo))
        R_1, R_2 = R_X.transpose(0, 2, 1), R_Y.transpose(0, 2, 1)
        arm = turned(R_1, difference(t_X, c))
        if part.scale == "shared":
            scales = np.full(E, answer.scale)
        else:
            of_frames = np.append(answer.own_scale, np.ones(len(part.fixed)))
            scales = np.where(part.owns_scale[at], of_frames[target], part.known_scales[at])
        return _stacked(R_1, R_2, Doubled(-arm.hi, -arm.lo), reciprocal(scales), turned(R_2, Doubled.of(t_Y)))

    def _of_directions(self, V: Array, h: float, at: slice) -> _Ends:
        """The coefficients of directions V (13 n + 1, D) about the gauge; with h = 1, of values of the variables."""
        part = self.part
        a, c = (each[at] for each in self._centres)
        (target, sensor), D = self.slots.frames[at].T, V.shape[1]
        frames = np.concatenate([V[:-1].reshape(-1, 13, D), np.zeros((1, 13, D))])
        tail = np.stack([V[-1], np.full(D, h)])
        tails = np.broadcast_to(tail, (len(target), 2, D))
        x = self.slots.variables(np.concatenate([frames[target], frames[sensor], tails], axis=1), at)
        x = x.transpose(0, 2, 1)  # (E, D, 25)
        R_1, R_2 = (x[:, :, at : at + 9].reshape(-1, D, 3, 3).transpose(0, 1, 3, 2) for at in (7, 16))
        t_1, t_2, s = Doubled.of(x[:, :, 0:3].copy()), Doubled.of(x[:, :, 3:6].copy()), Doubled.of(x[:, :, 6].copy())
        factor = V[-1] if part.is_scaled else np.full(D, h)
        if part.kind == "inverse" and part.scale != "shared":
            is_known = ~part.owns_scale[at]
            known = reciprocal(part.known_scales[at][is_known])
            s.hi[is_known], s.lo[is_known] = h * known.hi[:, None], h * known.lo[:, None]
        # A fixed frame's translation about the gauge is a difference, which a double would round.
        for e in np.flatnonzero((part.ends[at] >= len(part.free)).any(axis=1)):
            for name, t, centre in zip(part.pairs[at.start + e], (t_1, t_2), (c[e], a[e]), strict=True):
                if name not in part.fixed:
                    continue
                T = self.given.fixed[name]
                exact = difference(T[:3, 3], centre)
                if part.kind == "inverse":
                    exact = turned(T[None, :3, :3].transpose(0, 2, 1), Doubled(-exact.hi[None], -exact.lo[None]))
                    exact = Doubled(exact.hi[0], exact.lo[0])
                scaled = Doubled(exact.hi[None], exact.lo[None]).times(factor[:, None])
                t.hi[e], t.lo[e] = scaled
        if part.kind == "direct":  # R_A (t_1 + s c) + s t_A - (t_2 + s a)
            u = t_1.plus(_by_rows(s, c))
            one = t_2.plus(_by_rows(s, a))
            return _Ends(R_1, R_2, u, s, Doubled(-one.hi, -one.lo))
        moved = Doubled(R_2, np.zeros_like(R_2)).times(a[:, None, None, :]).summed(axis=3)
        return _Ends(R_1, R_2, t_1, s, moved.minus(t_2))

    def _of_point(self, point: Point) -> Callable[[slice], _Ends]:
        """The coefficients at values of the variables."""
        return lambda at: self._of_directions(np.append(point.numbers.ravel(), point.alpha)[:, None], 1.0, at)

    def _joined(self, first: _Ends, second: _Ends) -> _Ends:
        def of(name: str) -> Doubled:
            both = zip(getattr(first, name), getattr(second, name), strict=True)
            return Doubled(*(np.concatenate(each, axis=1) for each in both))

        R_1, R_2 = np.concatenate([first.R_1, second.R_1], axis=1), np.concatenate([first.R_2, second.R_2], axis=1)
        return _Ends(R_1, R_2, of("u"), of("s"), of("one"))

    def _coefficients(self, ends: _Ends, at: slice) -> tuple[Measured, Coefficients]:
        """The measurements and coefficients from which the sums of some pairs are computed."""
        E, D = ends.R_1.shape[:2]
        a, c = (each[at] for each in self._centres)
        front, back = Doubled.zeros(E, 3, 4, D, 12), Doubled.zeros(E, 3, 4, D, 12)
        one = Doubled.zeros(E, D, 12)
        R_1, R_2 = ends.R_1.transpose(0, 2, 1, 3), ends.R_2  # R_1 as [e, k, d, q]; R_2 as [e, d, p, k]
        for p in range(3):
            front.hi[:, p, :3, :, 3 * p : 3 * p + 3] = R_1
            back_p = -R_2[:, :, p, :].transpose(0, 2, 1)  # [e, k, d]
            for q in range(3):
                back.hi[:, :, q, :, 3 * p + q] = back_p
            back.hi[:, :, 3, :, 9 + p] = back_p
            for of_front, u, s in zip(front, ends.u, ends.s, strict=True):
                of_front[:, p, :3, :, 9 + p] = u.transpose(0, 2, 1)
                of_front[:, p, 3, :, 9 + p] = s
            for of_one, value in zip(one, ends.one, strict=True):
                of_one[:, :, 9 + p] = value[:, :, p]
        if self.part.kind == "inverse":
            for p in range(3):
                moved = product(-R_2[:, :, p, :].transpose(0, 2, 1)[:, :, None, :], c[:, None, :, None])  # [e, k, m, d]
                back.hi[:, :, :3, :, 9 + p], back.lo[:, :, :3, :, 9 + p] = moved
        coefficients = Coefficients(
            Doubled(*(each.reshape(E, 12, 12 * D) for each in front)),
            Doubled(*(each.reshape(E, 12, 12 * D) for each in back)),
            Doubled(*(each.reshape(E, 12 * D) for each in one)),
        )
        begin, end = at.start, at.start + E
        first, last = (bisect_left(self.given.batches, e, key=lambda batch: batch[0]) for e in (begin, end))
        batches = [(e - begin, raw) for e, raw in self.given.batches[first:last]]
        directed = list(self.part.directed_at(slice(begin, end)))
        shared = [own for each in self.given.shared if (own := each.of(begin, end)) is not None]
        return Measured(batches, a, c, self.part.kind == "inverse", shared, directed), coefficients

    # -- results ------------------------------------------------------------------------------------------------

    def _evaluated(self, point: Point, ends: Callable[[slice], _Ends], priors: Evaluation) -> Evaluation:
        cost, error = 0.0, 0.0
        size = 13 * len(self.part.free) + 1
        gradient, gradient_error = np.zeros((2, size))
        for at in self._blocks():
            measured, coefficients = self._coefficients(ends(at), at)
            sums = cost_sums(measured, coefficients)
            cost += 0.5 * float(np.sum(sums.products))
            error += 0.5 * float(sums.products_error.sum())
            for whole, of_block in zip((gradient, gradient_error), self._by_variables(sums, range(1), at), strict=True):
                whole += of_block[:, 0]
        error = error * (1.0 + 1e-9) + gamma(len(self.part.pairs) + 16) * cost
        gradient, gradient_error = gradient + priors.gradient, gradient_error * (1.0 + 1e-9) + priors.gradient_error
        total = cost + priors.cost
        return _Measured(
            point,
            total,
            error + priors.cost_error + gamma(2) * total,
            gradient,
            gradient_error + gamma(2) * np.abs(gradient),
            ends=ends,
        )

    def _by_variables(self, sums: Sums, directions: range, at_pairs: slice) -> tuple[Array, Array]:
        """The sums over features as Q V (13 n + 1, D) by variables, with a bound on its error: the chain rule."""
        factor = self.slots.factor[at_pairs]
        n, E = len(self.part.free), len(self.part.pairs)
        k, size, D = len(factor), 13 * n + 1, len(directions)
        result, bound = np.zeros((size, D)), np.zeros((size, D))
        for d in directions:
            at = slice(12 * d, 12 * d + 12)
            value = _by_pair([each[..., at] for each in sums.by_features], 1.0)
            bounds = zip(sums.by_features, sums.by_features_error, strict=True)
            error = _by_pair([bound[..., at] + gamma(8) * np.abs(of[..., at]) for of, bound in bounds], -1.0)
            shares = 0.5 * self.slots.summed(value * factor, at_pairs)
            slack = 0.5 * self.slots.summed((error + gamma(E + 40) * np.abs(value)) * np.abs(factor), at_pairs)
            of_fixed = self._of_fixed[at_pairs]
            slack[:, ALPHA] += 0.5 * (of_fixed.reshape(k, 6) * np.abs(value[:, :6])).sum(axis=1)
            for of_pairs, out in ((shares, result), (slack, bound)):
                frames = np.zeros((n, 13))
                for index, side in zip(self.slots.frames[at_pairs].T, SIDES, strict=True):
                    sum_into(frames, index[index < n], of_pairs[index < n, side])
                out[:, d] = np.append(frames.ravel(), of_pairs[:, ALPHA].sum())
        return result, bound * (1.0 + 1e-9)


def _by_pair(by_features: list[Array], minus: float) -> Array:
    """Derivatives (E, 25) by [t_X, t_Y, alpha, vec R_X, vec R_Y]; minus = -1 for sums of absolute values."""
    front, back, one = by_features
    E = len(one)
    F, K, of_one = front.reshape(E, 3, 4, 12), back.reshape(E, 3, 4, 12), one[:, 9:]
    by_R1, by_R2, by_u, by_s = np.zeros((E, 3, 3)), np.empty((E, 3, 3)), np.zeros((E, 3)), np.zeros(E)
    for p in range(3):
        by_R1 += F[:, p, :3, 3 * p : 3 * p + 3]  # [k, q]
        by_u += F[:, p, :3, 9 + p]
        by_s += F[:, p, 3, 9 + p]
        of_turn = K[:, :, 0, 3 * p] + K[:, :, 1, 3 * p + 1] + K[:, :, 2, 3 * p + 2]
        by_R2[:, p] = -minus * (of_turn + K[:, :, 3, 9 + p])  # [p, k]
    of_rotations = [by_R.transpose(0, 2, 1).reshape(E, 9) for by_R in (by_R1, by_R2)]
    return np.concatenate([by_u, -minus * of_one, by_s[:, None], *of_rotations], axis=1)


def _stacked(R_1: Array, R_2: Array, u: Doubled, s: Doubled, one: Doubled) -> _Ends:
    """One direction."""
    return _Ends(
        R_1[:, None],
        R_2[:, None],
        Doubled(u.hi[:, None], u.lo[:, None]),
        Doubled(s.hi[:, None], s.lo[:, None]),
        Doubled(one.hi[:, None], one.lo[:, None]),
    )


def _by_rows(s: Doubled, v: Array) -> Doubled:
    """s v for s (E, D) and v (E, 3), (E, D, 3)."""
    return Doubled(s.hi[:, :, None], s.lo[:, :, None]).times(v[:, None, :])
