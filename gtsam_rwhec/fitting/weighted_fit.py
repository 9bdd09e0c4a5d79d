"""The optimum of re-weighted measurements on the way of the outlier rejection: found by descents, and not certified.

A certificate on the way would say nothing about the answer, and where the gap is open it takes a search of its own:
outliers open it often. So a fit is the lowest end of two or three descents, from the last fit and from starts that know
nothing of it. What is kept at the end is solved and certified once (``robust_solution``).

With a scale for each target the certified form is C X'_j = Y'_k A (design fact 7). There the noise of a measured
rotation acts on a lever arm, so at that form's optimum the physical residuals are larger than sigma says. Outliers are
found by their physical residuals. So each fit is carried on to the nearest minimum of the physical cost,

    1/2 sum |alpha_j (R_A t_X + t_A - t_Y) - R_Y t_B|^2 / sigma^2 + kappa |R_A R_X - R_Y R_B|_F^2,

by GTSAM, from the same moments.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise

import gtsam
import numpy as np
from rwhec_factors import se3
from scipy.special import chdtri

from gtsam_rwhec.fitting import pose_graph as graphs
from gtsam_rwhec.fitting.pose_graph import optimise
from gtsam_rwhec.fitting.unknowns import State, Variables
from gtsam_rwhec.geometry.poses import Array, to_pose3
from gtsam_rwhec.problem.directions import axes_seen, axes_told, scaled, slides_of
from gtsam_rwhec.problem.measurements import Pair
from gtsam_rwhec.problem.problem import Problem
from gtsam_rwhec.problem.selection import AS_STATED, VarianceFactors
from gtsam_rwhec.solver.answers import Answer, answer_of, rotations_as_variables, scales_of
from gtsam_rwhec.solver.descent import descend, mirrored, spectral_start, unconstrained_start
from gtsam_rwhec.solver.parts import Part, parts_of
from gtsam_rwhec.solver.search import MIRROR_COST, Search
from gtsam_rwhec.solver.solve_options import SolveOptions

#: So many Newton steps lead from a start to its optimum; three to ten are usual.
MAX_DESCENT_STEPS = 50
#: So many Levenberg-Marquardt steps may lead from the certified optimum to the physical one; below ten is usual.
MAX_STEPS = 30


@dataclass(frozen=True)
class WeightedFit:
    """Poses (4, 4) of the frames that have a measurement, metres; alpha by target (or mover).

    A scale may be negative: outliers may make it so on the way.
    """

    poses: dict[str, Array]
    alpha: dict[str, float]

    @property
    def has_positive_scales(self) -> bool:
        """Whether every scale is positive and finite."""
        return all(0.0 < scale < np.inf for scale in self.alpha.values())


@np.errstate(all="ignore")
def weighted_fit(problem: Problem, previous: WeightedFit | None) -> WeightedFit:
    """The lowest optimum that descents find, from the previous poses too if there are any.

    Raises
    ------
    UnderdeterminedError
        If too few measurements are left.
    """
    poses: dict[str, Array] = {}
    alpha: dict[str, float] = {}
    known = previous if problem.directed else None
    about, scale = (None, 1.0) if known is None else (known.poses, known.alpha.get(problem.pairs[0].target, 1.0))
    parts = parts_of(problem, about, scale if problem.scale == "shared" else 1.0)
    for part in parts:
        answer = _solve(part, previous)
        for name, R, t in zip(part.free, answer.R, answer.t, strict=True):
            poses[name] = se3.pose(R, t + part.frame_shift(name))
        poses |= {name: problem.fixed[name] for name in part.fixed}
        alpha |= scales_of(part, answer)
    found = WeightedFit(poses, alpha)
    if problem.directed and previous is None and found.has_positive_scales:
        return weighted_fit(problem, found)  # with the directions there
    return at_physical_optimum(problem, parts, found)


def at_physical_optimum(problem: Problem, parts: list[Part], fit: WeightedFit) -> WeightedFit:
    """The nearest minimum of the physical cost for parts of the inverse equation; parts with a negative scale stay."""
    inverse = [
        part
        for part in parts
        if part.kind == "inverse" and all(0.0 < fit.alpha[pair.target] < np.inf for pair in part.pairs)
    ]
    if not inverse:
        return fit
    variables = Variables.of(problem, ())
    graph = gtsam.NonlinearFactorGraph()
    for part in inverse:
        for e in range(len(part.pairs)):
            graphs.add_summary(graph, variables, part, e, AS_STATED)
    graphs.add_knowledge(graph, variables, problem, "chordal")
    poses = {name: to_pose3(T[:3, :3], T[:3, 3]) for name, T in fit.poses.items()}
    start = State(
        X={name: poses[name] for name in problem.targets},
        Y={name: poses[name] for name in problem.sensors},
        scales={scale: fit.alpha[pair.target] for pair, scale in variables.scale_of_pair.items()},
        offsets_s={},
    )
    end = variables.state(optimise(graph, variables.values(start), MAX_STEPS).values)
    moved = {name for part in inverse for name in part.names}
    return WeightedFit(
        fit.poses | {name: pose.matrix() for name, pose in (end.X | end.Y).items() if name in moved},
        fit.alpha | {pair.target: end.scales[scale] for pair, scale in variables.scale_of_pair.items()},
    )


def _solve(part: Part, previous: WeightedFit | None) -> Answer:
    """A part's answer: the lowest end of the descents, or its mirror image where only that has positive scales."""
    search = Search.of(part, SolveOptions())
    form = search.form
    starts = spectral_start(part, search.whole.rotation)
    if previous is not None and all(name in previous.poses for name in part.free):
        before = np.array([previous.poses[name][:3, :3] for name in part.free]).reshape(-1, 3, 3)
        starts.append(rotations_as_variables(part, before))
    else:
        starts += unconstrained_start(form)
    ends = [descend(form, start, MAX_DESCENT_STEPS) for start in starts]
    best = min(ends, key=lambda end: end.cost)
    answer = answer_of(part, form, best.R)
    if not answer.has_positive_scales:
        image = descend(form, mirrored(part, best.R), MAX_DESCENT_STEPS)
        reflected = answer_of(part, form, image.R)
        if reflected.has_positive_scales and image.cost <= best.cost * (1.0 + MIRROR_COST) + search.rounding:
            return reflected
    return answer


@dataclass(frozen=True)
class Squares:
    """Whitened squared residuals of N measurements: about chi-square with 3 degrees of freedom each, at the truth."""

    #: (N,): kappa |R_A R_X - R_Y R_B|_F^2, which is 2 kappa theta^2 for a small angle; or the Mahalanobis distance
    #: under the rotation block of a full covariance. Infinite where a frame has no pose.
    rotation: Array
    #: (N,): |alpha (R_A t_X + t_A - t_Y) - R_Y t_B|^2 / sigma^2; or the same under the translation block.
    translation: Array
    #: (N, 6): log(B^-1 Y^-1 A X) in measured lengths, where full covariances were given.
    error: Array | None


@dataclass(frozen=True)
class Measured:
    """All raw measurements of a problem, pair by pair."""

    pairs: tuple[Pair, ...]
    #: The measurements of each pair.
    rows: tuple[slice, ...]
    #: (N, 4, 4)
    A: Array
    B: Array
    #: (N,)
    sigma: Array
    kappa: Array
    #: (N, 6, 6): inverse Cholesky factors of B's covariances, where full ones were given.
    whitening: Array | None
    #: (N, 3, 3): inverse Cholesky factors of the translation blocks alone.
    whitening_of_translation: Array | None
    #: (N, 6, 6) each, where something slides: the covariances, and the part of what slides.
    sliding: tuple[Array, Array] | None
    #: (N, 2): how many directions of rotation and of translation are measured.
    told: Array
    #: (N, 6): which entries of a residual are measured.
    seen: np.ndarray

    @staticmethod
    def of(problem: Problem, pairs: tuple[Pair, ...] | None = None) -> Measured:
        """The measurements of a problem that kept them: of some pairs, in their order, or of all."""
        pairs = problem.pairs if pairs is None else pairs
        raw = [problem.measurements(*pair) for pair in pairs]
        whitening = whitening_of_translation = sliding = None
        if problem.has_covariances:
            covariances = np.concatenate([np.empty((0, 6, 6)), *(one.covariance_of_B() for one in raw)])
            whitening = np.linalg.inv(np.linalg.cholesky(covariances))
            whitening_of_translation = np.linalg.inv(np.linalg.cholesky(covariances[:, 3:, 3:]))
            if problem.directed:
                each = [(slides_of(one), len(one.A)) for one in raw]
                slides = [np.zeros((count, 6, 6)) if found is None else found for found, count in each]
                sliding = covariances, np.concatenate(slides)
        bounds = np.cumsum([0, *(len(one.A) for one in raw)]).tolist()
        return Measured(
            pairs,
            tuple(slice(first, end) for first, end in pairwise(bounds)),
            np.concatenate([np.empty((0, 4, 4)), *(one.A for one in raw)]),
            np.concatenate([np.empty((0, 4, 4)), *(one.B for one in raw)]),
            np.concatenate([np.empty(0), *(one.sigma for one in raw)]),
            np.concatenate([np.empty(0), *(one.kappa for one in raw)]),
            whitening,
            whitening_of_translation,
            sliding,
            np.concatenate([np.empty((0, 2)), *(axes_told(one) for one in raw)]),
            np.concatenate([np.empty((0, 6), dtype=bool), *(axes_seen(one) for one in raw)]),
        )

    def pair_of(self, index: int) -> Pair:
        """The pair of a measurement."""
        return next(pair for pair, rows in zip(self.pairs, self.rows, strict=True) if index < rows.stop)

    def by_pair(self, values: np.ndarray) -> dict[Pair, np.ndarray]:
        """Values (N,) of all measurements, by pair."""
        return {pair: values[rows] for pair, rows in zip(self.pairs, self.rows, strict=True)}

    def squares(self, fit: WeightedFit) -> Squares:
        """The squared residuals at an answer."""
        R = np.empty((len(self.A), 3, 3))
        t = np.empty((len(self.A), 3))
        R_Y = np.empty((len(self.A), 3, 3))
        known = np.ones(len(self.A), dtype=bool)
        for (target, sensor), rows in zip(self.pairs, self.rows, strict=True):
            if target not in fit.poses or sensor not in fit.poses:
                known[rows] = False
                R[rows] = R_Y[rows] = np.eye(3)
                t[rows] = 0.0
                continue
            X, Y = fit.poses[target], fit.poses[sensor]
            A, B = self.A[rows], self.B[rows]
            R[rows] = A[:, :3, :3] @ X[:3, :3]
            R_Y[rows] = Y[:3, :3]
            t[rows] = fit.alpha[target] * (A[:, :3, :3] @ X[:3, 3] + A[:, :3, 3] - Y[:3, 3])
            t[rows] -= B[:, :3, 3] @ Y[:3, :3].T
        if self.whitening is None or self.whitening_of_translation is None:
            chord = R - R_Y @ self.B[:, :3, :3]
            rotation = self.kappa * np.einsum("nij,nij->n", chord, chord)
            translation = np.einsum("ni,ni->n", t, t) / self.sigma**2
            error = None
        else:
            seen = self.B[:, :3, :3].transpose(0, 2, 1) @ R_Y.transpose(0, 2, 1)  # into the measured target's axes
            error = se3.logmap(se3.pose(seen @ R, np.einsum("nij,nj->ni", seen, t))) * self.seen
            rotation = _norms(self.whitening[:, :3, :3], error[:, :3])  # L is lower triangular
            translation = _norms(self.whitening_of_translation, error[:, 3:])
            error[~known] = np.inf
        return Squares(np.where(known, rotation, np.inf), np.where(known, translation, np.inf), error)

    def together(self, squares: Squares, factors: VarianceFactors) -> Array:
        """Squared residuals (N,) of all six components, about chi-square with 6 degrees of freedom at the truth."""
        if squares.error is None or self.whitening is None:
            return self.as_of_six(squares.rotation / factors.rotation + squares.translation / factors.translation)
        known = np.isfinite(squares.rotation)
        deviation, error, result = np.sqrt(np.repeat(factors, 3)), squares.error[known], np.full(len(known), np.inf)
        if self.sliding is None:
            result[known] = _norms(self.whitening[known], error / deviation)
        else:
            covariances, slides = self.sliding
            noise = scaled(covariances[known], slides[known], deviation)
            result[known] = np.einsum("ni,ni->n", error, np.linalg.solve(noise, error[:, :, None])[:, :, 0])
        return self.as_of_six(result)

    def as_of_six(self, squares: Array) -> Array:
        """Squared residuals (N,) as those of six components."""
        return as_of_six(squares, self.told.sum(axis=1))


#: Residuals of fewer components are compared with those of six where one of a thousand good ones is larger.
RARE = 1e-3
#: The components of a pose's residual.
DOF = 6


def as_of_six(squares: Array, told: Array) -> Array:
    """Squared residuals (N,) of ``told`` (N,) components as those of six: one threshold then serves all."""
    if (told == DOF).all():
        return squares
    result: Array = squares * float(chdtri(DOF, RARE)) / chdtri(np.maximum(told, 1.0), RARE)
    return result


def _norms(whitening: Array, error: Array) -> Array:
    white = np.einsum("nij,nj->ni", whitening, error)
    square: Array = np.einsum("ni,ni->n", white, white)
    return square


#: A frame has at most this many proposals, sampled evenly in the order of the residuals.
PROPOSALS = 50


def by_vote(
    name: str, problem: Problem, fit: WeightedFit, factors: VarianceFactors, threshold: float
) -> tuple[WeightedFit, float]:
    """The fit with one frame moved to where most of its measurements agree, and the decrease of sum min(d^2, c^2).

    The frame may lack a pose before. The fit stays as given where no proposal is better. ``threshold`` is c^2.
    """
    own = Measured.of(problem, tuple(pair for pair in problem.pairs if name in pair and not pair.is_motion))

    def cost_of(candidate: WeightedFit) -> tuple[float, Array]:
        d = own.together(own.squares(candidate), factors)
        return float(np.minimum(d, threshold).sum()), d

    before, d = cost_of(fit)
    best, least = fit, before
    order = np.argsort(np.minimum(d, np.finfo(float).max), kind="stable")
    for index in order[np.unique(np.linspace(0, len(order) - 1, PROPOSALS).astype(int))] if len(order) else ():
        T = _proposed(name, int(index), own, fit)
        if T is None:
            continue
        candidate = replace(fit, poses={**fit.poses, name: T})
        cost, _ = cost_of(candidate)
        if cost < least:
            best, least = candidate, cost
    return best, before - least


def _proposed(name: str, index: int, own: Measured, fit: WeightedFit) -> Array | None:
    """X = A^-1 Y B or Y = A X B^-1 of one measurement, true lengths; None if the pair's other frame has no pose."""
    pair = own.pair_of(index)
    other = pair.sensor if pair.target == name else pair.target
    alpha = fit.alpha.get(pair.target, np.nan)
    if other not in fit.poses or not np.isfinite(alpha) or alpha == 0.0:
        return None
    A, B = own.A[index], own.B[index].copy()
    B[:3, 3] /= alpha
    if pair.target == name:
        X: Array = np.linalg.solve(A, fit.poses[other] @ B)
        return X
    Y: Array = np.linalg.solve(B.T, (A @ fit.poses[other]).T).T
    return Y
