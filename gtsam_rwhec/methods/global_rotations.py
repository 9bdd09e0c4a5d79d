"""Global minima by semidefinite relaxations over rotations: Wise 2020 and Heller 2014, with all weights 1.

A radian weighs as much as a metre (times the square root of two, by the Frobenius norm). Translations and a shared
scale are eliminated exactly: x'Q'x over x = [vec R_1, ..., vec R_n, 1] is the smallest cost for given rotations (RWHEC
paper, eq. 48), its 1/2 included. Wise's relaxation has 21 quadratic constraints a rotation. Heller's first relaxation
over quaternions, in which the cost has degree four, is Lasserre's of order two (`solve_moments`).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache, partial
from typing import Literal

import clarabel
import numpy as np
import scipy.sparse
from rwhec_factors.se3 import pose, so3_nearest
from scipy.linalg import block_diag

from gtsam_rwhec.errors import FrameError, OptionError, ScaleError
from gtsam_rwhec.geometry.poses import Array, one_transform
from gtsam_rwhec.geometry.quaternions import ROTATION, to_rotations
from gtsam_rwhec.methods.method import UNWEIGHTED, Method, MethodOptions, Outcome, Poses, Properties, Takes
from gtsam_rwhec.problem.problem import Problem
from gtsam_rwhec.solver.answers import answer_of, as_point
from gtsam_rwhec.solver.bound import lower_bound
from gtsam_rwhec.solver.descent import descend
from gtsam_rwhec.solver.part_form import PartForm
from gtsam_rwhec.solver.parts import Part, parts_of
from gtsam_rwhec.solver.reduced_form import ReducedForm
from gtsam_rwhec.solver.relaxation import (
    Relaxation,
    round_to_rotations,
    solve_by_clarabel,
    solve_conic,
    triangle,
    unstacked,
)
from gtsam_rwhec.solver.rotations import CONSTRAINTS, kkt_multipliers, unvec
from gtsam_rwhec.solver.small_dual import scatter

#: The name of this cost in ``Estimate.proof``.
COST = "J with all weights 1"


@dataclass(frozen=True)
class UnitForm:
    """The form of one connected problem, and the way back to its poses.

    With ``turned`` it is the form of B X^-1 = Y^-1 A, whose frames are the inverses of the problem's frames.
    """

    part: Part
    forms: PartForm
    turned: bool

    @staticmethod
    def of(problem: Problem, *, turned: bool = False) -> UnitForm:
        """The form of raw measurements; FrameError for a problem that falls into unconnected parts."""
        parts = parts_of(unit_weights(problem, turned=turned))
        if len(parts) > 1:
            raise FrameError(
                f"the measurements fall into {len(parts)} unconnected parts (one part has "
                f"{', '.join(parts[0].names)}); solve each part as a problem of its own"
            )
        return UnitForm(parts[0], PartForm.of(parts[0]), turned)

    @property
    def reduced(self) -> ReducedForm:
        """Q', translations eliminated."""
        return self.forms.reduced

    @property
    def rotations_alone(self) -> ReducedForm:
        """The form of the rotation residuals alone."""
        form = self.forms.rotation  # over [vec R] of each frame; the numbers before it, [t, s], have no residual here
        before = (13 - form.frames.shape[1], 0)
        return ReducedForm.of(
            replace(
                form,
                frames=np.pad(form.frames, ((0, 0), before, before)),
                tails=np.pad(form.tails, ((0, 0), before, (0, 0))),
                couplings=np.pad(form.couplings, ((0, 0), before, before)),
            )
        )

    def rotations_of(self, X: Poses, Y: Poses) -> Array:
        """Rotations (n, 3, 3) of given poses, as the form has them."""
        poses = {**X, **Y}
        R = np.array([one_transform(poses[name], f"start of {name}")[:3, :3] for name in self.part.free])
        return np.ascontiguousarray(R.transpose(0, 2, 1)) if self.turned else R

    def outcome(self, R: Array, starts_from: str | None = None, notes: tuple[str, ...] = ()) -> Outcome[Poses]:
        """Poses with the best translations (and scale) for rotations R (n, 3, 3); ScaleError if the scale is <= 0."""
        answer = answer_of(self.part, self.reduced, R)
        if not answer.scale > 0.0:
            raise ScaleError(
                f"the scale of least cost is {answer.scale:.6g}; a real scale is positive. Check the conventions of "
                "the poses, or move along more than one circle or sphere"
            )
        T: Array = pose(answer.R, answer.t + np.array([self.part.frame_shift(name) for name in self.part.free]))
        if self.turned:
            T = np.linalg.inv(T)
        poses = dict(zip(self.part.free, T, strict=True))
        X = {name: poses[name] for name in self.part.targets}
        Y = {name: poses[name] for name in self.part.sensors}
        return Outcome(X, Y, answer.scale, starts_from=starts_from, notes=notes)


def unit_weights(problem: Problem, *, turned: bool = False) -> Problem:
    """The same measurements with sigma = 1 m and kappa = 1; ``turned``: as B X^-1 = Y^-1 A."""
    plain = Problem(problem.scale, keep_measurements=turned)
    for target, sensor in problem.pairs:
        raw = problem.measurements(target, sensor)
        A, B = (raw.B, raw.A) if turned else (raw.A, raw.B)
        if target == sensor:
            plain.add_motion(sensor, A, B)
        else:
            plain.add(target, sensor, A, B)
    return plain


#: Order of a quaternion's entries, scalar first. The solver's last digits, and so its bound, depend on the order.
_ENTRIES = (3, 0, 1, 2)
#: (a, b) of the ten products q_a q_b.
PRODUCTS = [(_ENTRIES[i], _ENTRIES[j]) for i in range(4) for j in range(i, 4)]
#: The interior-point solver stops at this relative gap and infeasibility.
TOLERANCE = 1e-11
#: The interior-point solver takes at most this many steps, and so does the descent after it.
STEPS = 200


def products_to_rotation() -> Array:
    """(9, 10): vec R = L [q_a q_b]."""
    return np.array([(1.0 + (a != b)) * ROTATION[a, b].T.ravel() for a, b in PRODUCTS]).T


@dataclass(frozen=True)
class MomentSolution:
    """Starts (list of (n, 3, 3) rotations), a lower bound on the cost, and whether a single point has these moments.

    ``eigenvalue_ratio`` is the second eigenvalue of M(y y') over the first: zero if only one answer is optimal and
    the relaxation is tight.
    """

    starts: list[Array]
    lower_bound: float
    eigenvalue_ratio: float


@dataclass(frozen=True)
class _MomentPlaces:
    """The index of the moment in each entry of M(y y') and M(z z'), and the equations of the moments."""

    even: np.ndarray
    odd: np.ndarray
    equations: scipy.sparse.csc_matrix


@cache
def _moment_places(frames: int) -> _MomentPlaces:
    """The places for one or two quaternions."""
    place: dict[tuple[int, ...], int] = {}

    def index(exponents: np.ndarray) -> int:
        return place.setdefault(tuple(int(e) for e in exponents), len(place))

    unit = np.eye(4 * frames, dtype=int)
    y = [np.zeros(4 * frames, dtype=int)]
    y += [unit[4 * k + a] + unit[4 * k + b] for k in range(frames) for a, b in PRODUCTS]
    even = np.array([[index(p + q) for q in y] for p in y])
    z = [unit[a] + unit[4 + b] for a in _ENTRIES for b in _ENTRIES] if frames == 2 else []
    odd = np.array([[index(p + q) for q in z] for p in z], dtype=int).reshape(len(z), len(z))
    rows = [np.eye(len(place))[even[0, 0]]]
    for k in range(frames):
        for m in y:
            row = np.zeros(len(place))
            for a in range(4):
                row[index(m + 2 * unit[4 * k + a])] += 1.0
            row[index(m)] -= 1.0
            rows.append(row)
    return _MomentPlaces(even, odd, scipy.sparse.csc_matrix(np.array(rows)))


def solve_moments(Q: Array) -> MomentSolution:
    """Lasserre's relaxation of order two of x'Q'x, x = [vec R_1, (vec R_2,) 1], Q' (10, 10) or (19, 19).

    vec R is linear in the ten products q_a q_b. With y = [1, products of q_1, products of q_2] the cost is y'Cy, and
    the unknowns are moments, the integrals of the monomials by a measure on pairs of unit quaternions:

        minimise <C, M(y y')>   subject to   M(y y') >= 0,   M(z z') >= 0 for z = q_1 (x) q_2,
                                             moments of m |q_k|^2 = those of m,   moment of 1 = 1

    The flips q_k -> -q_k change nothing, so moments of odd degree vanish, and these blocks are all.
    """
    frames = (len(Q) - 1) // 9
    moments = _moment_places(frames)
    to_x = np.roll(block_diag(*[products_to_rotation()] * frames, np.eye(1)), 1, axis=1)  # y has its 1 first
    C = to_x.T @ Q @ to_x
    scale = float(np.abs(C).max()) or 1.0
    equations, count = moments.equations, moments.equations.shape[1]
    cost = np.zeros(count)
    np.add.at(cost, moments.even, C / scale)
    blocks = [block for block in (moments.even, moments.odd) if block.size]
    cones = [clarabel.ZeroConeT(equations.shape[0]), *[clarabel.PSDTriangleConeT(len(block)) for block in blocks]]
    A = scipy.sparse.vstack([equations, *[-_triangle(block, count) for block in blocks]], format="csc")
    b = np.zeros(A.shape[0])
    b[0] = 1.0
    mu, z, _ = solve_conic(cost, A, b, cones, TOLERANCE, STEPS)
    values = np.linalg.eigvalsh(mu[moments.even])
    return MomentSolution(
        _rounded(mu[moments.even], frames),
        scale * _lower_bound(cost, A, z, equations.shape[0], blocks),
        float(max(values[-2], 0.0) / values[-1]),
    )


def _triangle(block: np.ndarray, count: int) -> scipy.sparse.csc_matrix:
    """The linear map from the moments to the stacked entries of a block."""
    i, j, weight = triangle(len(block))
    return scipy.sparse.csc_matrix((weight, (np.arange(len(i)), block[i, j])), (len(i), count))


def _lower_bound(cost: Array, A: scipy.sparse.csc_matrix, z: Array, equations: int, blocks: list[np.ndarray]) -> float:
    """A lower bound that holds (up to rounding) for any multipliers z: -z_0, less what the solver's tolerance leaves.

    For the moments mu of any unit quaternions, cost' mu is -z_0 + sum <Z, M> + r' mu with r = cost + A' z. No moment
    exceeds 1. The trace of M(y y') is at most 1 + n, the trace of M(z z') is 1. The smallest change of z that makes r
    vanish comes first.
    """
    z = z - np.linalg.lstsq(A.T.toarray(), cost + A.T @ z, rcond=None)[0]
    bound = -float(z[0]) - float(np.abs(cost + A.T @ z).sum())
    start = equations
    for block, trace in zip(blocks, (1.0 + (len(blocks[0]) - 1) // 10, 1.0), strict=False):
        bound += trace * min(0.0, float(np.linalg.eigvalsh(unstacked(z[start:], len(block)))[0]))
        start += len(block) * (len(block) + 1) // 2
    return bound


def _rounded(M: Array, frames: int) -> list[Array]:
    """Rotations from the second moments of each quaternion, and from the rotation matrices that these moments mean."""
    by_quaternion = np.empty((frames, 3, 3))
    for k in range(frames):
        second = np.zeros((4, 4))
        for (a, b), moment in zip(PRODUCTS, M[0, 1 + 10 * k : 11 + 10 * k], strict=True):
            second[a, b] = second[b, a] = moment
        by_quaternion[k] = to_rotations(np.linalg.eigh(second)[1][:, -1])
    products = M[0, 1:].reshape(frames, 10)
    by_matrix = so3_nearest(unvec(products @ products_to_rotation().T))
    return [by_quaternion, by_matrix]


#: The interior-point solver stops at this relative gap and infeasibility.
WISE_TOLERANCE = 1e-10
#: Below this second eigenvalue over the first, the solution has rank one, and the relaxation is tight.
RANK_ONE = 1e-5


@dataclass(frozen=True)
class GlobalMinimum:
    """Rotations (n, 3, 3) of the lowest cost, a lower bound on every answer's cost, and how tight the relaxation is.

    ``eigenvalue_ratio`` is the relaxation's second eigenvalue over its first.
    """

    R: Array
    cost: float
    lower_bound: float
    eigenvalue_ratio: float

    @property
    def gap(self) -> float:
        """Cost minus bound, relative to the cost; it says nothing of exact data, whose cost is rounding error."""
        return (self.cost - self.lower_bound) / max(self.cost, 1e-300)

    def outcome(self, form: UnitForm, is_optimal: bool, note: str) -> Outcome[Poses]:
        """The method's answer."""
        return replace(
            form.outcome(self.R, notes=(note,)),
            cost=self.cost,
            cost_name=COST,
            lower_bound=self.lower_bound,
            is_optimal=is_optimal,
        )


def wise2020(problem: Problem, options: MethodOptions) -> Outcome[Poses]:
    """Solve for one X and one Y, or one sensor's motions; known or shared scale."""
    form = UnitForm.of(problem)
    found = certified_rotations(form)
    is_tight = found.eigenvalue_ratio < RANK_ONE
    proof = "the relaxation is tight"
    if not is_tight:
        proof = f"the relaxation is not tight (eigenvalues' ratio {found.eigenvalue_ratio:.1e}): nothing is proven"
    return found.outcome(form, is_tight, f"{proof}; relative gap {found.gap:.1e}")


def certified_rotations(form: UnitForm) -> GlobalMinimum:
    """Solve the relaxation by Clarabel, descend from its rotations, and take the best of three lower bounds."""
    reduced = form.reduced
    Q = reduced.Q
    relaxation = solve_by_clarabel(Q, WISE_TOLERANCE, STEPS)
    ends = [descend(reduced, R, STEPS) for R in round_to_rotations(relaxation)]
    best = min(ends, key=lambda end: end.cost)
    whole = form.forms
    point = as_point(form.part, answer_of(form.part, reduced, best.R))
    evaluation = whole.cost.at(point)
    of_answer = kkt_multipliers(best.R, evaluation.gradient[:-1].reshape(-1, 13)[:, 4:])
    bounds = [
        lower_bound(whole, evaluation, multipliers).lower_bound for multipliers in (relaxation.multipliers, of_answer)
    ]
    bounds.append(_relaxation_bound(Q, relaxation))
    values = np.linalg.eigvalsh(relaxation.X)
    return GlobalMinimum(best.R, best.cost, max(bounds), float(max(values[-2], 0.0) / values[-1]))


def _relaxation_bound(Q: Array, relaxation: Relaxation) -> float:
    """gamma + (3 n + 1) min(0, lambda_min(Z)), as x'x = 3 n + 1: the best bound where the relaxation is not tight."""
    Z = Q - scatter(np.einsum("nk,kij->nij", relaxation.multipliers, CONSTRAINTS))
    Z[-1, -1] -= relaxation.dual
    trace = (len(Q) - 1) / 3.0 + 1.0
    return relaxation.dual + trace * min(0.0, float(np.linalg.eigvalsh(Z)[0]))


WISE = Method(
    name="wise2020",
    properties=Properties("SE(3)", certifiable=True, monocular=True),
    source="E. Wise, M. Giamou, S. Khoubyarian, A. Grebe and J. Kelly, Certifiably optimal monocular hand-eye "
    "calibration, IEEE MFI 2020",
    assumes=f"{UNWEIGHTED} The answer says whether it is proven optimal.",
    function=wise2020,
    takes=frozenset({Takes.SHARED_SCALE, Takes.MOTIONS}),
)


Parameterisation = Literal["quaternion", "matrix"]
#: Each parameterisation's first relaxation, in words.
RELAXATIONS: dict[Parameterisation, str] = {
    "quaternion": "order 2 over quaternions",
    "matrix": "order 1 over rotation matrices",
}
#: A relaxation counts as tight up to this gap, relative to the cost: the solver's multipliers leave as much.
TIGHT = 1e-5
#: For exact data the gap counts relative to the cost of a grossly wrong answer; this is its limit.
ROUNDING = 1e-8


def heller2014(
    problem: Problem, options: MethodOptions, parameterisation: Parameterisation = "quaternion"
) -> Outcome[Poses]:
    """Solve for one X and one Y, or one sensor's motions, of known scale."""
    form = UnitForm.of(problem)
    found, is_tight = global_minimum(form, parameterisation)
    note = (
        f"the relaxation of {RELAXATIONS[parameterisation]} is {'tight' if is_tight else 'not tight'}: cost "
        f"{found.cost:.6g}, bound {found.cost - found.lower_bound:.1e} below it"
    )
    return found.outcome(form, is_tight, note if is_tight else f"{note}; the next order was not tried")


def global_minimum(form: UnitForm, parameterisation: Parameterisation = "quaternion") -> tuple[GlobalMinimum, bool]:
    """Solve the relaxation and descend from its answer; the minimum, and whether the bound proves it.

    OptionError for another parameterisation.
    """
    if parameterisation not in RELAXATIONS:
        raise OptionError(f"heller2014: parameterisation={parameterisation!r} is not 'quaternion' or 'matrix'")
    if parameterisation == "matrix":
        found = certified_rotations(form)
    else:
        relaxed = solve_moments(form.reduced.Q)
        best = min((descend(form.reduced, start, STEPS) for start in relaxed.starts), key=lambda end: end.cost)
        found = GlobalMinimum(best.R, best.cost, min(relaxed.lower_bound, best.cost), relaxed.eigenvalue_ratio)
    limit = max(TIGHT * found.cost, ROUNDING * form.reduced.magnitude)
    return found, bool(found.cost - found.lower_bound <= limit)


_SOURCE = (
    "J. Heller, D. Henrion and T. Pajdla, Hand-eye and robot-world calibration by global polynomial optimization, "
    "ICRA 2014"
)


def _method(name: str, parameterisation: Parameterisation, representation: str) -> Method[[Problem, MethodOptions]]:
    return Method(
        name=name,
        properties=Properties(representation, certifiable=True),
        source=_SOURCE,
        assumes=f"{UNWEIGHTED} The answer says whether it is proven optimal.",
        function=partial(heller2014, parameterisation=parameterisation),
        takes=frozenset({Takes.MOTIONS}),
    )


HELLER = _method("heller2014", "quaternion", "unit quaternions")
HELLER_MATRIX = _method("heller2014_matrix", "matrix", "rotation matrices")
