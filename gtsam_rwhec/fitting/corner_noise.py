"""The rows at one point, summed by instant: what the noise's likelihood and the covariance need of them.

All sums are in pixels: rows are not divided by the corners' deviation. With the common unknowns theta (poses, cameras,
shapes) and the carriers' errors a_i at the instants, to first order

    r = r_0 + J theta + J_i a_i + P c + noise,    a_i ~ N(0, S),

so the sums G = J'J, C_i = J_i'J, M_i = J_i'J_i, g = J'r_0, b_i = J_i'r_0 and r_0'r_0 are all, with what the errors c
that an image's corners share take from them (`common_errors`).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import TypeAlias

import numpy as np
from rwhec_factors import se3
from scipy.linalg import block_diag

from gtsam_rwhec.fitting.common_errors import Carriers, CommonErrors, OfStack
from gtsam_rwhec.fitting.corner_model import Model, Point, Rows, Sums
from gtsam_rwhec.fitting.corner_patterns import OF_AN_IMAGE, patterns
from gtsam_rwhec.fitting.joint_covariance import Arrow, ArrowInverse, EliminationOrder
from gtsam_rwhec.geometry.blas_threads import one_blas_thread
from gtsam_rwhec.geometry.poses import Array

Vector: TypeAlias = np.ndarray[tuple[int], np.dtype[np.float64]]

#: Noise is looked for between these standard deviations: pixels of a corner; rad, and m, of the carriers' poses.
CORNER_PX = (1e-3, 30.0)
CARRIER = (1e-7, 0.1)
#: Deviations below this (rad, m) move no corner.
NOTHING = 1e-6
#: What an image's corners share is looked for from this share of a corner's deviation to so many pixels, since more is
#: no detector's; it counts from twice that share.
LEAST_COMMON, MOST_COMMON_PX = 0.02, 0.3
#: Where it is there, about this share of a corner's deviation.
TYPICAL = 0.1


@dataclass(frozen=True, eq=False)
class Noise:
    """Standard deviations: of a corner (pixels), and of A's right perturbation (rad, m); 0: A is exact.

    And of each pattern in which an image's corners are off together (pixels).
    """

    corner_px: float
    carrier_rad: float
    carrier_m: float
    common_px: float = 0.0

    @property
    def carrier(self) -> Array | None:
        """The deviations of [omega, v] (6,), or None for exact poses."""
        if self.carrier_rad == 0.0 and self.carrier_m == 0.0:
            return None
        return np.repeat([self.carrier_rad, self.carrier_m], 3)

    def change(self, before: Noise) -> float:
        """The largest change of a deviation since before, as a share; deviations that move nothing do not count."""
        pairs = [(getattr(before, field.name), getattr(self, field.name)) for field in fields(self)]
        return max(abs(b - a) / max(a, b) if max(a, b) > NOTHING else 0.0 for a, b in pairs)


@dataclass(frozen=True, eq=False)
class WithoutCarriers:
    """H, h and r'F^-1 r of the measurements, without the carriers' errors; the prior is not among them."""

    H: Array
    h: Array
    rr: float


@dataclass(frozen=True, eq=False)
class Reduced:
    """Sums of the rows."""

    #: "x", "y", "k", "b", "t", "p" with the frame's name: its rows in theta.
    slots: Mapping[tuple[str, str], slice]
    #: Of all rows.
    sums: Sums
    #: Number of residuals, weights counted.
    count: float
    #: (d, d): The precision of the prior on theta, and `prior_off` (d,) how far the point is from its mean.
    prior: Array
    prior_off: Array
    #: Of every pattern; an image's corners share the first of them.
    patterns: CommonErrors

    @staticmethod
    def of(model: Model, point: Point, slots: Mapping[tuple[str, str], slice] | None = None) -> Reduced:
        """The sums at a point; of a part of a model's images in the whole's `slots`.

        The errors of the point's A are taken off the residuals, to first order.
        """
        slots = slots or model.slots(point)
        sums, number, common = Sums.zeros(len(model.A), slots), 0.0, []
        to_right, (off_A, _) = model.to_right, errors_of_A(model, point)
        for stack, weights in zip(model.stacks, model.weights, strict=True):
            rows, where = model.linearised(stack, point), model.columns(stack, slots)
            root = np.repeat(np.sqrt(weights), 2, axis=1)
            by_A = rows.by_A @ to_right[stack.instant]
            of_stack = Rows(
                np.concatenate(list(model.by_unknown(stack, rows).values()), axis=2) * root[..., None],
                rows.by_corners * root.reshape(*stack.known.shape, 2, 1) if stack.targets[0] in point.corners else None,
                (rows.residual - np.einsum("vni,vi->vn", by_A, off_A[stack.instant])) * root,
            )
            J_A = by_A * root[..., None]
            places = stack.places(where, len(sums.squares))
            sums.add(stack, places, of_stack, J_A)
            number += 2.0 * float(weights[stack.known].sum())
            P = patterns(model, stack, point, rows=rows) * root[..., None]
            of_P, Pt = of_stack.times(P), P.transpose(0, 2, 1)
            common.append(OfStack(stack, where, places, of_P[..., :-1], Pt @ J_A, of_P[..., -1], Pt @ P))
        prior = _prior(model, point, slots, len(sums.squares) - 1)
        return Reduced(slots, sums, number, *prior, CommonErrors(tuple(common)))

    @staticmethod
    def whitened(model: Model, point: Point) -> Reduced:
        """The sums at a point of rows of unit noise, what images' corners share among it."""
        slots, sums, (off_A, R) = model.slots(point), model.sums(point), errors_of_A(model, point)
        of_A, M = R.transpose(0, 2, 1) @ sums.of_A, R.transpose(0, 2, 1) @ sums.M @ R
        sums.squares[:, -1] -= np.einsum("nid,ni->d", of_A, off_A)
        of_A[..., -1] -= (M @ off_A[..., None])[..., 0]
        prior = _prior(model, point, slots, len(sums.squares) - 1)
        return Reduced(slots, Sums(sums.squares, of_A, M), 0.0, *prior, CommonErrors(()))

    @property
    def G(self) -> Array:
        """(d, d): By the unknowns."""
        return self.sums.squares[:-1, :-1]

    @property
    def g(self) -> Array:
        """(d,): By the unknowns and the residual."""
        return self.sums.squares[:-1, -1]

    @property
    def rr(self) -> float:
        """Of the residual."""
        return float(self.sums.squares[-1, -1])

    @property
    def C(self) -> Array:
        """(I, 6, d): By A and the unknowns."""
        return self.sums.of_A[..., :-1]

    @property
    def b(self) -> Array:
        """(I, 6): By A and the residual."""
        return self.sums.of_A[..., -1]

    @property
    def M(self) -> Array:
        """(I, 6, 6): By A."""
        return self.sums.M

    @cached_property
    def _order(self) -> EliminationOrder:
        return EliminationOrder.of(self.G + self.prior)

    @cached_property
    def _of_prior(self) -> tuple[np.ndarray, ...]:
        return np.nonzero(self.prior)

    def joint(self, noise: Noise) -> tuple[Reduced, ArrowInverse, float]:
        """The sums without common errors, the covariance of all, and log |F| + log |H|; LinAlgError if there is none.

        All are theta (d,), and the carriers' errors (6 I) in deviations, where A has noise. What of them is many and
        tied to nothing alike is eliminated first: the carriers, or the targets.
        """
        sums, log_det = self.without_common(noise)
        s2, S, d = noise.corner_px**2, noise.carrier, len(self.G)
        whole = sums.G / s2 + self.prior
        if S is None:
            arrow = self._order.split(whole)
        else:
            A, places = np.eye(6) + sums.M * S[:, None] * S / s2, d + np.arange(6 * len(sums.M)).reshape(-1, 6)
            C = sums.C * S[:, None] / s2
            if self._order.blocks.size <= places.size:
                arrow = Arrow(places, np.arange(d), A, C, whole)
            else:
                arrow = self._order.split(whole).with_more(C.reshape(-1, d), block_diag(*A))
        inverse = arrow.inverse()
        return sums, inverse, log_det + self.count * float(np.log(s2)) + inverse.log_det

    def estimate(self, noise: Noise, sums: Reduced, inverse: ArrowInverse) -> tuple[Array, Array]:
        """The gradient of half the cost by all that is in `joint`, and its best change."""
        pull = sums.g / noise.corner_px**2 + self.prior @ self.prior_off
        if noise.carrier is not None:
            pull = np.r_[pull, (sums.b * noise.carrier / noise.corner_px**2).ravel()]
        return pull, -inverse.times(pull)

    def minus_two_log_likelihood(self, noise: Noise) -> tuple[float, Array]:
        """Restricted: theta integrated out; and its derivatives by the logarithms of the deviations.

        With the carriers' errors a eliminated, K_i = (S^-1 + M_i / s^2)^-1,

            H = G / s^2 - sum C_i' K_i C_i / s^4 + prior,    -2 log L = r' F^-1 r - h' H^-1 h + log |F| + log |H|.

        All of it is of the information of (theta, a): `joint`. The derivative by a component's log variance is its
        number less its squares, as estimated and as uncertain, over its variance (Patterson and Thompson's equations).
        """
        try:
            return self.of_joint(noise, *self.joint(noise))
        except np.linalg.LinAlgError:
            return np.inf, np.zeros(4)

    def of_joint(self, noise: Noise, sums: Reduced, inverse: ArrowInverse, log_det: float) -> tuple[float, Array]:
        """The same, of what `joint` gave."""
        s2, d = noise.corner_px**2, len(self.G)
        pull, found = self.estimate(noise, sums, inverse)
        places = np.arange(d, len(found)).reshape(-1, 6)
        theta, variances = found[:d], inverse.diagonal[places]
        value = sums.rr / s2 + float(self.prior_off @ self.prior @ self.prior_off) + float(pull @ found) + log_det
        by_prior = inverse.at(*(each[:, None] for each in self._of_prior)).ravel()
        free = d - float(self.prior[self._of_prior] @ by_prior) + float((1.0 - variances).sum())
        squares = sums.rr + 2.0 * float(sums.g @ theta) + float(theta @ sums.G @ theta)
        gradient = np.zeros(4)
        if noise.carrier is not None:
            a = found[places] * noise.carrier
            squares += float(np.einsum("ni,nij,nj->", a, sums.M, a)) + 2.0 * float(
                (a * (sums.b + sums.C @ theta)).sum()
            )
            off = 2.0 * (len(a) - (found[places] ** 2 + variances).sum(axis=0))
            gradient[1:3] = off[:3].sum(), off[3:].sum()
        # with t / s as it is, the sums without common errors are those of white noise
        gradient[0] = 2.0 * (self.count - squares / s2 - free)
        if noise.common_px and noise.carrier is not None:
            of_a = Carriers(places, noise.carrier)
            gradient[3] = self.common.twice_by_log(noise.common_px, s2, found, inverse, of_a)
            gradient[0] -= gradient[3]
        return value, gradient

    @cached_property
    def common(self) -> CommonErrors:
        """Of what an image's corners share."""
        return self.patterns.orthogonal(OF_AN_IMAGE)

    def without_common(self, noise: Noise) -> tuple[Reduced, float]:
        """The sums without what images' corners share, and the gain of the logarithm of the determinant."""
        if not noise.common_px:
            return self, 0.0
        of, s2 = self.common, noise.corner_px**2
        inverses, log_det = of.inverse(noise.common_px, s2)
        sums = self.sums.copy()
        for of_stack, K in zip(of.stacks, inverses, strict=True):
            root = np.sqrt(K) / noise.corner_px  # R'P K P'R / s^2 is a sum of squares
            rows = Rows(root * of_stack.of_unknowns, None, root[..., 0] * of_stack.of_residual)
            sums.add(of_stack.stack, of_stack.places, rows, root * of_stack.of_A, sign=-1.0)
        return replace(self, sums=sums), log_det

    def without_carriers(self, noise: Noise) -> WithoutCarriers:
        """The sums of the measurements under a noise, the carriers' errors eliminated."""
        sums, s2, S = self.without_common(noise)[0], noise.corner_px**2, noise.carrier
        H, h, rr = sums.G / s2, sums.g / s2, sums.rr / s2
        if S is not None:
            # K = D (I + D M D / s2)^-1 D, D = diag(S)
            K = np.linalg.inv(np.eye(6) + sums.M * S[:, None] * S / s2) * S[:, None] * S
            flat, Kb = sums.C.reshape(-1, len(H)), (K @ sums.b[..., None])[..., 0] / s2
            H = H - flat.T @ (K @ sums.C / s2).reshape(flat.shape) / s2
            h = h - flat.T @ Kb.ravel() / s2
            rr -= float((sums.b * Kb).sum()) / s2
        return WithoutCarriers(H, h, rr)

    def information(self, noise: Noise) -> Array:
        """The information (d, d) of theta under a noise, the carriers' errors eliminated."""
        return self.without_carriers(noise).H + self.prior

    def likeliest(self, start: Noise, *, carrier: bool = True) -> Noise:
        """The noise of greatest restricted likelihood; with `carrier` false, the carriers' noise is as it is."""
        deviations, free = deviations_of(start), self.free(start, carrier=carrier)
        # steps of equal length are about as likely: by how many errors tell each deviation
        t = TYPICAL * start.corner_px
        K = np.concatenate(self.common.inverse(t, start.corner_px**2)[0])
        shared = float(((1.0 - K / t**2) ** 2).sum())
        told = np.array([self.count, 3 * len(self.M), 3 * len(self.M), shared])[free]
        unit = 1.0 / np.sqrt(np.maximum(told, 1.0))
        begin = np.log(np.maximum(deviations, [0.0, 1e-5, 1e-5, LEAST_COMMON * start.corner_px]))[free] / unit

        def noise(x: Vector) -> Noise:
            found = deviations.copy()
            found[free] = np.exp(x * unit)
            return Noise(*found.tolist())

        def cost(x: Vector) -> tuple[float, Array]:
            value, gradient = self.minus_two_log_likelihood(noise(x))
            return value, gradient[free] * unit

        common = LEAST_COMMON * start.corner_px, MOST_COMMON_PX
        limits = np.log([(CORNER_PX, CARRIER, CARRIER, common)[i] for i in free]) / unit[:, None]
        from scipy.optimize import minimize  # here, since its import takes as long as the work of few poses

        bounds: list[tuple[float, float]] = [(low, high) for low, high in limits.tolist()]
        found = noise(
            minimize(cost, begin, jac=True, bounds=bounds, method="L-BFGS-B", options={"ftol": 1e-11, "gtol": 1e-4}).x
        )
        return found if found.common_px > 2.0 * LEAST_COMMON * found.corner_px else replace(found, common_px=0.0)

    def free(self, noise: Noise, *, carrier: bool) -> list[int]:
        """Which deviations are estimated.

        Images' corners share nothing where A counts as exact, since that would be A's noise by another name, nor where
        each corner's own place is free.
        """
        shares = noise.carrier is not None and not any(letter == "p" for letter, _ in self.slots)
        shares &= 2.0 * LEAST_COMMON * noise.corner_px < MOST_COMMON_PX
        return [0, *((1, 2) if carrier else ()), *((3,) if shares else ())]


def errors_of_A(model: Model, point: Point) -> tuple[Array, Array]:
    """A's perturbations (I, 6) from where it was measured, and what turns changes of them to the right (I, 6, 6)."""
    moved = se3.logmap(se3.inverse(model.A) @ point.A)
    off_A = np.linalg.solve(model.to_right, moved[..., None])[..., 0]
    return off_A, np.linalg.solve(se3.right_jacobian_inverse(moved), model.to_right)


def _prior(model: Model, point: Point, slots: Mapping[tuple[str, str], slice], size: int) -> tuple[Array, Array]:
    """`Reduced.prior` and `Reduced.prior_off`."""
    vectors, prior, off = model.vectors(point), np.zeros((size, size)), np.zeros(size)
    for at, of in model.priors(point).items():
        prior[slots[at], slots[at]] = of.precision
        off[slots[at]] = vectors[at] - of.mean
    return prior, off


def deviations_of(noise: Noise) -> Array:
    """All of them (4,)."""
    return np.array([getattr(noise, field.name) for field in fields(noise)])


#: The step of numeric derivatives by the logarithm of a deviation.
STEP = 1e-3
#: Fewer degrees of freedom than this are not told from noise; and no deviation is known less than from one.
FEWEST, LEAST_KNOWN = 3.0, 1.0


@one_blas_thread()
def degrees_of_freedom(reduced: Reduced, noise: Noise, *, carrier: bool) -> dict[tuple[str, str], float]:
    """Of each unknown's covariance; with `carrier` false only the corners' noise was estimated."""
    deviations = deviations_of(noise)
    free = [i for i in reduced.free(noise, carrier=carrier) if i == 0 or deviations[i] > NOTHING]

    def at(step: Array) -> tuple[ArrowInverse, Array]:
        moved = deviations.copy()
        moved[free] *= np.exp(step)
        of_step = Noise(*moved.tolist())
        joint = reduced.joint(of_step)
        return joint[1], reduced.of_joint(of_step, *joint)[1][free]

    above, below = ([at(step) for step in sign * STEP * np.eye(len(free))] for sign in (1.0, -1.0))
    # by log v = 2 log s
    hessian = np.array([up - down for (_, up), (_, down) in zip(above, below, strict=True)]) / (2.0 * STEP) / 4.0
    values, vectors = np.linalg.eigh(0.5 * (hessian + hessian.T))
    V = (vectors * (2.0 / np.maximum(values, LEAST_KNOWN))) @ vectors.T
    result: dict[tuple[str, str], float] = {}
    widths = {name: rows.stop - rows.start for name, rows in reduced.slots.items()}
    for width in set(widths.values()):
        names = [name for name in widths if widths[name] == width]
        own = np.array([reduced.slots[name].start for name in names])[:, None] + np.arange(width)
        up, down = ([np.linalg.slogdet(of.at(own, own))[1] for of, _ in every] for every in (above, below))
        w = (np.array(up) - np.array(down)) / (4.0 * STEP) / width
        variances = np.einsum("in,ij,jn->n", w, V, w).tolist()
        result |= {n: max(2.0 / v, FEWEST) if v > 0.0 else float("inf") for n, v in zip(names, variances, strict=True)}
    return {name: result[name] for name in reduced.slots}


#: A corner with an error of more deviations is left out: of good ones, whose errors are Rayleigh's, 1 in 10,000.
LIMIT = 4.3
#: In the first round outliers are in the fit: the limit is wider by this factor.
LOOSE = 1.5
#: The median of Rayleigh's distribution of unit deviation.
MEDIAN = 1.1774


def errors_px(model: Model, point: Point) -> list[Array]:
    """Lengths (V, n) of all corners' errors, in pixels, by stack; zero where a corner was not seen."""
    every = replace(model, weights=tuple(stack.known.astype(float) for stack in model.stacks), corner_px=1.0, common=())
    return [
        np.linalg.norm(error.reshape(*stack.known.shape, 2), axis=2)
        for stack, error in zip(model.stacks, every.errors(point), strict=True)
    ]


def weights_of(model: Model, point: Point, noise: Noise, *, first: bool) -> tuple[Array, ...]:
    """1 for corners that count, 0 for outliers and for corners that were not seen, by stack.

    In the first round the corners' deviation is told by the median error, which outliers hardly move. An error has what
    the image's corners share in it, too: along each axis up to two patterns.
    """
    errors = errors_px(model, point)
    limit = LIMIT * float(np.sqrt(noise.corner_px**2 + 2.0 * noise.common_px**2))
    if first:
        seen = np.concatenate([error[stack.known] for error, stack in zip(errors, model.stacks, strict=True)])
        limit = LOOSE * LIMIT * float(np.median(seen)) / MEDIAN
    return tuple(
        (stack.known & (error <= limit)).astype(float) for error, stack in zip(errors, model.stacks, strict=True)
    )
