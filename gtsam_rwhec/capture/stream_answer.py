"""The answer of a stream's sums: certified from the last one, with the noise that they show and covariances.

With weights W_k / g_k for the residuals of rotation and of translation (k), the certified answer has the information
H = sum_k H_k. Where the variances are f_k times those of the weights, its covariance is P M P with P = H^-1 and
M = sum_k f_k H_k (the sandwich), and the squared residuals have the expectations

    E[r_k' W_k r_k] = f_k (3 N - 2 tr P H_k) + sum_j f_j tr(P H_j P H_k),

two linear equations for f_R and f_t (Rao's MINQUE; Searle, Casella and McCulloch, Variance Components, 1992, chapter
11). Both hold for any g, so g need not follow f at each measurement: it is f rounded to steps.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from gtsam_rwhec.fitting.joint_covariance import JointCovariance
from gtsam_rwhec.fitting.unknowns import Unknown, UnknownKind
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.problem.selection import VarianceFactors
from gtsam_rwhec.solver.answers import PairPoses, costs_of_pairs, rotations_as_variables, scales_of
from gtsam_rwhec.solver.identification import identify_with_basis, typical_length
from gtsam_rwhec.solver.information import PartInformation, pair_information, prior_information
from gtsam_rwhec.solver.parts import Part
from gtsam_rwhec.solver.search import Search
from gtsam_rwhec.solver.solution import PartSolution
from gtsam_rwhec.solver.solve_options import SolveOptions

#: Below so many redundant equations of a kind the noise counts as unknown.
FEWEST_SPARE = 1.0
#: Standard deviations are at least this, rad and m, so that exact data can be divided by them.
QUIETEST = 1e-8


@dataclass(frozen=True)
class PartAnswer:
    """A connected part: its certified answer, and what its residuals say."""

    solution: PartSolution
    unknowns: tuple[Unknown, ...]
    unit: Array
    #: (d, d) each: P, and H_R and H_t without priors, and the priors' information
    inverse: Array
    of_residuals: tuple[Array, Array]
    of_priors: Array
    free: Array  #: (d, k)
    squares: Array  #: (2,): r_k' W_k r_k
    expected: Array  #: (2, 2): their expectations for unit variances f of both kinds
    spare: Array  #: (2,): redundant equations of both kinds, 3 N - tr P H_k

    @property
    def part(self) -> Part:
        """The part with its moments."""
        return self.solution.part

    def covariance(self, f: Array) -> Array:
        """P M P (d, d), without the free directions."""
        M = f[0] * self.of_residuals[0] + f[1] * self.of_residuals[1] + self.of_priors
        result: Array = self.inverse @ M @ self.inverse
        return result


def answered(part: Part, before: Mapping[str, Array], options: SolveOptions) -> PartAnswer:
    """A part's certified answer, by a descent from rotations (3, 3) that were found before; where these do not lead to
    a proof, or a frame has none, by the search that ``rw.solve`` makes."""
    search = Search.of(part, options)
    R = None
    if part.free and all(name in before for name in part.free):
        R = rotations_as_variables(part, np.array([before[name] for name in part.free]))
    searched = search.ended(search.with_positive_scale(search.run("auto", R)))
    solution = PartSolution.of(searched)
    poses = PairPoses.of(part, solution.answer)
    told = PartInformation.of(part, pair_information(part, poses), searched.order)
    J = np.array([each.sum() for each in costs_of_pairs(part, poses)])[::-1]
    used = told.used
    H_R, H_t = (each.dense()[np.ix_(used, used)] for each in (told.rotation, told.translation))
    D_R, D_t = (np.diag(np.append(each.ravel(), 0.0)[used]) for each in prior_information(part))
    unknowns, unit = _unknowns_of(part, solution, used)
    free = np.zeros((len(unit), 0))
    if not solution.identifiability.is_unique:
        free = identify_with_basis(part, poses, *costs_of_pairs(part, poses), searched.order)[1][used]
    # The information is of the scales' logarithms.
    logarithm = np.where(_is_scale(unknowns), unit, 1.0)
    H_R, H_t, D = (each / logarithm[:, None] / logarithm for each in (H_R, H_t, D_R + D_t))
    joint = JointCovariance.of(unknowns, H_R + H_t, free * logarithm[:, None], unit)
    P, H = joint.finite, np.array([H_R - D_R, H_t - D_t])
    PH = P @ H
    traces, crossed = np.einsum("kii->k", PH), np.einsum("jab,kba->kj", PH, PH)
    spare = 3.0 * part.number_of_measurements - traces
    expected = np.diag(3.0 * part.number_of_measurements - 2.0 * traces) + crossed
    return PartAnswer(solution, unknowns, unit, P, (H[0], H[1]), D, joint.free, 2.0 * J, expected, spare)


def _is_scale(unknowns: tuple[Unknown, ...]) -> np.ndarray:
    return np.repeat([u.kind is UnknownKind.SCALE for u in unknowns], [u.dimension for u in unknowns])


def _unknowns_of(part: Part, solution: PartSolution, used: np.ndarray) -> tuple[tuple[Unknown, ...], Array]:
    """The unknowns in the order of the information's parameters, and the unit of each parameter."""
    unknowns, unit = [], []
    scales, length = scales_of(part, solution.answer), typical_length(part)
    for i, name in enumerate(part.free):
        unknowns.append(Unknown(UnknownKind.FRAME, name))
        unit += [1.0] * 3 + [length] * 3
        if used[7 * i + 6]:
            unknowns.append(Unknown(UnknownKind.SCALE, name))
            unit.append(scales[name])
    if used[-1]:
        unknowns.append(Unknown(UnknownKind.SCALE))
        unit.append(solution.answer.scale)
    return tuple(unknowns), np.array(unit)


@dataclass(frozen=True)
class NoiseShown:
    """The noise that the residuals of all parts show."""

    factors: VarianceFactors  #: of the variances as stated
    degrees_of_freedom: tuple[float, float]  #: of rotation and of translation


def noise_of(parts: list[PartAnswer], weights: VarianceFactors) -> NoiseShown | None:
    """The noise, by residuals weighted with ``weights``; None where these are too few to tell it."""
    squares, expected = np.sum([p.squares for p in parts], axis=0), np.sum([p.expected for p in parts], axis=0)
    spare = np.sum([p.spare for p in parts], axis=0)
    if not (spare > FEWEST_SPARE).all():
        return None
    f = np.linalg.solve(expected, squares)
    f = np.where((f > 0.0).all(), f, squares / spare)  # by chance, where there are few
    of_weights = np.sum([(p.part.moments.kappa.sum(), p.part.moments.weight.sum()) for p in parts], axis=0)
    count = sum(p.part.number_of_measurements for p in parts)
    f = np.maximum(f, QUIETEST**2 * of_weights / count * (2.0, 1.0))
    return NoiseShown(VarianceFactors(*(f * weights).tolist()), (float(spare[0]), float(spare[1])))
