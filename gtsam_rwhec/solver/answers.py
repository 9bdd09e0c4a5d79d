"""Points at which a cost is evaluated, and the results: enclosed costs, gradients, products with directions.

A direction and a gradient are vectors over the form's variables without h, about the part's gauge: 13 numbers for each
leaf, 13 for each center, [t (3), own scale, vec R (9)], then alpha; (13 n + 1,) in all.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from gtsam_rwhec.errors import ScaleError
from gtsam_rwhec.files.terminal_text import shown
from gtsam_rwhec.geometry.poses import Array, PoseLike, one_transform
from gtsam_rwhec.problem.knowledge import checked_scale
from gtsam_rwhec.problem.measurements import Pair
from gtsam_rwhec.problem.problem import Problem
from gtsam_rwhec.solver.descent import SearchForm, homogeneous
from gtsam_rwhec.solver.parts import Part, parts_of
from gtsam_rwhec.solver.rotations import unvec, vec


@dataclass(frozen=True)
class Point:
    """Values of the form's variables about the gauge: numbers (n, 13), [t, own scale, vec R], and alpha."""

    numbers: Array
    alpha: float

    @property
    def rotations(self) -> Array:
        """(n, 3, 3), as variables of the form."""
        return unvec(self.numbers[:, 4:])


@dataclass(frozen=True)
class Evaluation:
    """The cost at a point and half of its gradient Q x, each with a bound on its error.

    ``point`` has the values of the variables, rounded; the cost is that of the values as they are.
    """

    point: Point
    cost: float
    cost_error: float
    gradient: Array
    gradient_error: Array
    unknown: float = 0.0  #: what the moments' own rounding may change in the cost, where measurements were not kept

    @property
    def upper(self) -> float:
        """The cost, rounded up: the exact cost is at most this."""
        upper = float(np.nextafter(self.cost + self.cost_error * (1.0 + 1e-9), np.inf))
        return 0.0 if upper < 0.0 else upper


@dataclass(frozen=True)
class Action:
    """The form's products with directions V (13 n + 1, D): Q V, V'Q V and V'Q x, each with a bound on its error."""

    QV: Array
    QV_error: Array
    VQV: Array
    VQV_error: Array
    VQx: Array
    VQx_error: Array
    #: Magnitudes of the terms that cancel in each product; given only where the products come from moments.
    sizes: tuple[Array, Array, Array] | None = None


class Form(Protocol):
    """A quadratic cost, evaluated with bounds on the rounding: from raw measurements, or from their moments."""

    def at(self, point: Point) -> Evaluation:
        """The cost at values of the variables."""

    def action(self, evaluation: Evaluation, V: Array) -> Action:
        """The form's products with directions, and of directions with the evaluated point."""


@dataclass(frozen=True)
class Answer:
    """Poses X and Y of the free frames about a part's gauge (never inverted), in metres.

    R (n, 3, 3) and t (n, 3) have the order of ``part.free``. own_scale (n,) is nan for a frame without an own scale,
    and ``scale`` is the shared scale. A scale that the measurements leave free is 1.
    """

    R: Array
    t: Array
    own_scale: Array
    scale: float

    @property
    def has_positive_scales(self) -> bool:
        """Whether every scale is positive and finite."""
        scales = np.append(self.own_scale[~np.isnan(self.own_scale)], self.scale)
        return bool(((scales > 0.0) & np.isfinite(scales)).all())


def answer_of(part: Part, form: SearchForm, R: Array) -> Answer:
    """The answer with the optimal translations and scales for given rotations of the form (eq. 47)."""
    return answer_at(part, R, *form.recover(homogeneous(R)))


def answer_at(part: Part, R: Array, numbers: Array, alpha: float) -> Answer:
    """The answer at values of the form's variables: R (n, 3, 3), numbers (n, 4) as [t, own scale], and alpha."""
    t, s = numbers[:, :3], numbers[:, 3]
    own_scale = np.full(len(R), np.nan)
    if part.kind == "direct":
        scale = alpha if part.scale == "shared" else 1.0
        return Answer(R, t / scale if scale else t, own_scale, scale)
    with np.errstate(divide="ignore"):
        owners = frozenset(part.scale_owners)
        own = np.array([name in owners for name in part.free], dtype=bool)
        own_scale[own] = 1.0 / s[own]
        scale = float(1.0 / np.float64(alpha)) if part.scale == "shared" else 1.0
    inverse_R = R.transpose(0, 2, 1)
    return Answer(inverse_R, -np.einsum("nij,nj->ni", inverse_R, t), own_scale, scale)


def scales_of(part: Part, answer: Answer) -> dict[str, float]:
    """The scale alpha of each frame's measurements: shared, known, or the frame's own."""
    own = dict(zip(part.free, answer.own_scale.tolist(), strict=True))
    scales = dict.fromkeys(part.names, answer.scale if part.scale == "shared" else 1.0) | part.fixed_scales
    return scales | {name: own[name] for name in part.scale_owners}


def as_point(part: Part, answer: Answer) -> Point:
    """The values of the form's variables at an answer, about the part's gauge: the inverse of ``answer_of``."""
    numbers = np.zeros((len(answer.R), 13))
    if part.kind == "direct":
        alpha = answer.scale if part.scale == "shared" else 1.0
        numbers[:, :3] = alpha * answer.t
        numbers[:, 4:] = vec(answer.R)
        return Point(numbers, answer.scale)
    inverse_R = answer.R.transpose(0, 2, 1)
    numbers[:, :3] = -np.einsum("nij,nj->ni", inverse_R, answer.t)
    has = np.isfinite(answer.own_scale)
    with np.errstate(divide="ignore"):
        numbers[has, 3] = 1.0 / answer.own_scale[has]
        alpha = float(1.0 / np.float64(answer.scale))
    numbers[:, 4:] = vec(inverse_R)
    return Point(numbers, alpha)


def rotations_as_variables(part: Part, R: Array) -> Array:
    """Rotations of frames as variables of the form: transposed in the inverse form."""
    return R if part.kind == "direct" else np.ascontiguousarray(R.transpose(0, 2, 1))


def given_answer(
    part: Part, X: Mapping[str, PoseLike], Y: Mapping[str, PoseLike], scale: float | Mapping[str, float]
) -> Answer:
    """The user's poses as an answer, about the part's gauge."""
    stacked = given_poses(part, X, Y)
    shift = np.array([part.frame_shift(name) for name in part.free]).reshape(-1, 3)
    owners = set(part.scale_owners)
    own = np.array([_scale_of(name, scale) if name in owners else np.nan for name in part.free])
    shared = checked_scale(scale, "the answer's scale of all targets") if part.scale == "shared" else 1.0
    return Answer(np.ascontiguousarray(stacked[:, :3, :3]), stacked[:, :3, 3] - shift, own, shared)


def given_poses(part: Part, X: Mapping[str, PoseLike], Y: Mapping[str, PoseLike]) -> Array:
    """The user's poses of the free frames (n, 4, 4) as they were given, in metres about the user's origin."""
    of_frames = [(X, "X") if name in part.targets else (Y, "Y") for name in part.free]
    poses = [
        one_transform(of[name], f"{what}[{name!r}]") for name, (of, what) in zip(part.free, of_frames, strict=True)
    ]
    return np.array(poses).reshape(-1, 4, 4)


def parts_about(
    problem: Problem, X: Mapping[str, PoseLike], Y: Mapping[str, PoseLike], scale: float | Mapping[str, float]
) -> list[Part]:
    """The parts of a problem, with the directions of measurements at an answer."""
    shared = float(scale) if problem.scale == "shared" and not isinstance(scale, Mapping) else 1.0
    return parts_of(problem, poses_of(X, Y) if problem.directed else None, shared)


def poses_of(X: Mapping[str, PoseLike], Y: Mapping[str, PoseLike]) -> dict[str, Array]:
    """The user's poses (4, 4) by name."""
    return {name: one_transform(T, f"the pose of {name}") for name, T in (*X.items(), *Y.items())}


def _scale_of(name: str, scale: float | Mapping[str, float]) -> float:
    """A frame's own scale: its entry, or the one number for all."""
    if isinstance(scale, Mapping) and name not in scale:
        raise ScaleError(f"the answer's scale lacks {name}; it has {', '.join(map(shown, scale)) or 'nothing'}")
    return checked_scale(scale[name] if isinstance(scale, Mapping) else scale, f"the answer's scale of {name}")


@dataclass(frozen=True, slots=True)
class Residual:
    """Root mean squares of a pair's residuals, weighted as in the cost.

    ``translation_rms_m`` is of |R_A t_X + t_A - t_Y - R_Y t_B / scale|, in true metres; ``rotation_rms_rad`` of the
    angle between R_A R_X and R_Y R_B.
    """

    number_of_measurements: int
    translation_rms_m: float
    rotation_rms_rad: float


@dataclass(frozen=True)
class PairPoses:
    """An answer, pair by pair: R_X, R_Y (E, 3, 3), t_X, t_Y (E, 3) about the gauge, scale alpha (E,)."""

    R_X: Array
    t_X: Array
    R_Y: Array
    t_Y: Array
    alpha: Array

    @staticmethod
    def of(part: Part, answer: Answer) -> PairPoses:
        """Free frames from the answer, fixed ones from the part."""
        fixed = np.array(list(part.fixed.values())).reshape(-1, 4, 4)
        R, t = np.concatenate([answer.R, fixed[:, :3, :3]]), np.concatenate([answer.t, fixed[:, :3, 3]])
        target, sensor = part.ends.T
        alphas = scales_of(part, answer)
        return PairPoses(R[target], t[target], R[sensor], t[sensor], np.array([alphas[name] for name, _ in part.pairs]))


def costs_of_pairs(part: Part, poses: PairPoses) -> tuple[Array, Array]:
    """J_t and J_R of each pair (E,), eq. 18."""
    E, moments = len(part.pairs), part.moments
    J_t, J_R = np.empty(E), np.empty(E)
    for at in moments.blocks():
        G = moments.fronts(at)
        R_X, R_Y, alpha = poses.R_X[at], poses.R_Y[at], poses.alpha[at, None]
        k = len(G)
        # The residual alpha (R_A t_X + t_A - t_Y) - R_Y t_B is linear in the features [vec R_A, t_A, t_B, 1].
        linear = np.zeros((k, 3, 16))
        linear[:, :, :9] = np.einsum("ej,ik->eijk", alpha * poses.t_X[at], np.eye(3)).reshape(k, 3, 9)
        linear[:, :, 9:12] = alpha[:, :, None] * np.eye(3)
        linear[:, :, 12:15] = -R_Y
        linear[:, :, 15] = -alpha * poses.t_Y[at]
        J_t[at] = 0.5 * ((linear @ G) * linear).sum(axis=(1, 2))
        # |R_A R_X|^2 + |R_Y R_B|^2 - 2 <R_A R_X, R_Y R_B>, with sum kappa R_A[k, i] R_B[q, p] at [i, k, p, q].
        squares = moments.kappa[at] * ((R_X**2).sum(axis=(1, 2)) + (R_Y**2).sum(axis=(1, 2)))
        cross = moments.rotations(at).reshape(k, 3, 3, 3, 3)
        J_R[at] = 0.5 * squares - np.einsum("ekp,ekp->e", np.einsum("eikpq,eip->ekq", cross, R_X), R_Y)
    for directed in part.directed:
        e, alpha = directed.e, poses.alpha[directed.e]
        t = alpha * np.r_[poses.t_X[e], poses.t_Y[e], 1.0]
        x = np.r_[t, poses.R_X[e].T.ravel(), poses.R_Y[e].T.ravel()]
        J_t[e], J_R[e] = directed.costs(*part.centres(e), x)
    return np.maximum(J_t, 0.0), np.maximum(J_R, 0.0)  # zero may round to a negative number


def residuals_of_pairs(part: Part, poses: PairPoses, J_t: Array, J_R: Array) -> dict[Pair, Residual]:
    """Costs as root mean squares in metres and radians."""
    rms = np.sqrt(2.0 * J_t / part.moments.weight) / np.abs(poses.alpha)
    chord = np.sqrt(2.0 * J_R / part.moments.kappa)  # |R_A R_X - R_Y R_B|_F = sqrt(8) sin(angle / 2)
    angle = 2.0 * np.arcsin(np.minimum(1.0, chord / np.sqrt(8.0)))
    found = map(Residual, part.moments.count.tolist(), rms.tolist(), angle.tolist())
    return dict(zip(part.pairs, found, strict=True))
