"""The cost of priors at poses as they are returned, enclosed (design fact 11).

kappa |R - R_0|_F^2 / 2 and |t - t_0|^2 / (2 sigma^2). In the inverse form X' = X^-1 about the gauge's point c, and
t_0 - t is, turned, the residual t_X' + R_X' (t_0 - c), which is linear in the variables.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.geometry.rounding import Doubled, difference, gamma, turned
from gtsam_rwhec.problem.knowledge import Prior
from gtsam_rwhec.solver.parts import Part
from gtsam_rwhec.solver.point import Action, Evaluation, Point

#: More rounded operations than any number of a prior needs after its residual, which has a relative error of one.
OPERATIONS = 40


@dataclass(frozen=True)
class MeasuredPriors:
    """The priors of a part, about the user's origin."""

    part: Part
    priors: dict[str, list[Prior]]

    def at_poses(self, R: Array, t: Array) -> Evaluation:
        """The cost of frames R (n, 3, 3), t (n, 3) about the user's origin."""
        residuals = {}
        for i, prior, name in self._each():
            t_0 = prior.transform[:3, 3]
            if self.part.kind == "direct":
                residuals[i, name] = difference(t[i], t_0).value
            else:
                residuals[i, name] = turned(R[None, i].transpose(0, 2, 1), _row(difference(t_0, t[i]))).value[0]
        form_R = R if self.part.kind == "direct" else R.transpose(0, 2, 1)
        return self._evaluated(form_R, residuals)

    def at(self, point: Point) -> Evaluation:
        """The cost at values of the variables about the gauge."""
        residuals, R = {}, point.rotations
        for i, prior, name in self._each():
            t, about = point.numbers[i, :3], self._about_gauge(i, prior)
            if self.part.kind == "direct":
                residuals[i, name] = Doubled.of(t).minus(about).value
            else:
                residuals[i, name] = turned(R[None, i], _row(about)).plus(_row(Doubled.of(t))).value[0]
        return self._evaluated(R, residuals)

    def action(self, point: Point, V: Array) -> Action:
        """What the priors' form does to directions V (13 n + 1, D)."""
        D = V.shape[1]
        QV, size = np.zeros_like(V), np.zeros_like(V)
        products, of_products = np.zeros((D, D + 1)), np.zeros((D, D + 1))
        residuals = self.at(point)
        VQx = V.T @ residuals.gradient
        VQx_error = np.abs(V).T @ (residuals.gradient_error + gamma(len(V)) * np.abs(residuals.gradient))
        for i, prior, _ in self._each():
            first = 13 * i
            t, r = V[first : first + 3], V[first + 4 : first + 13]
            if prior.sigma is not None:
                weight = 0.5 / prior.sigma**2
                about = self._about_gauge(i, prior).value
                rows = t if self.part.kind == "direct" else t + _times(r, about)
                # The size of the terms that cancel in the rows.
                terms = np.abs(t) if self.part.kind == "direct" else np.abs(t) + _times(np.abs(r), np.abs(about))
                for out, value, s in ((QV, rows, about), (size, terms, np.abs(about))):
                    out[first : first + 3] += weight * value
                    if self.part.kind == "inverse":
                        out[first + 4 : first + 13] += weight * np.einsum("k,pd->kpd", s, value).reshape(9, D)
                products[:, :D] += weight * rows.T @ rows
                of_products[:, :D] += weight * terms.T @ terms
            if prior.kappa is not None:
                weight = 0.5 * prior.kappa
                QV[first + 4 : first + 13] += weight * r
                size[first + 4 : first + 13] += weight * np.abs(r)
                products[:, :D] += weight * r.T @ r
                of_products[:, :D] += weight * np.abs(r).T @ np.abs(r)
        unit = gamma(OPERATIONS)
        return Action(QV, unit * size, products[:, :D], unit * of_products[:, :D], VQx, VQx_error)

    def _each(self) -> Iterator[tuple[int, Prior, int]]:
        """The frame's index, the prior, and its number, of each prior of a free frame."""
        for i, name in enumerate(self.part.free):
            for number, prior in enumerate(self.priors.get(name, [])):
                yield i, prior, number

    def _about_gauge(self, i: int, prior: Prior) -> Doubled:
        return difference(prior.transform[:3, 3], self.part.frame_shift(self.part.free[i]))

    def _evaluated(self, R: Array, residuals: dict[tuple[int, int], Array]) -> Evaluation:
        """The cost from the translation residuals of each frame and prior; rotations as the form has them."""
        n = len(R)
        gradient, size, cost = np.zeros(13 * n + 1), np.zeros(13 * n + 1), 0.0
        for i, prior, number in self._each():
            first = 13 * i
            if prior.sigma is not None:
                residual, weight = residuals[i, number], 0.5 / prior.sigma**2
                about = self._about_gauge(i, prior).value
                cost += weight * float(residual @ residual)
                for out, value, s in ((gradient, residual, about), (size, np.abs(residual), np.abs(about))):
                    out[first : first + 3] += weight * value
                    if self.part.kind == "inverse":
                        out[first + 4 : first + 13] += weight * np.outer(s, value).ravel()
            if prior.kappa is not None:
                R_0 = prior.transform[:3, :3]
                off = (R[i] - (R_0 if self.part.kind == "direct" else R_0.T)).T.ravel()  # column after column
                cost += 0.5 * prior.kappa * float(off @ off)
                gradient[first + 4 : first + 13] += 0.5 * prior.kappa * off
                size[first + 4 : first + 13] += 0.5 * prior.kappa * np.abs(off)
        count = len(self.priors) + sum(len(priors) for priors in self.priors.values())
        unit = gamma(OPERATIONS + count)
        none = Point(np.zeros((0, 13)), 0.0)
        return Evaluation(none, cost, unit * cost, gradient, unit * size)


def _row(v: Doubled) -> Doubled:
    """One vector as a stack of one."""
    return Doubled(v.hi[None], v.lo[None])


def _times(r: Array, v: Array) -> Array:
    """R v for vec R (9, D) of directions, column after column: (3, D)."""
    result: Array = np.einsum("kpd,k->pd", r.reshape(3, 3, -1), v)
    return result
