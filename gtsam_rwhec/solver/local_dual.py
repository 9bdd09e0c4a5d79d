"""The small dual of many frames: only the few whose Z curves down get other multipliers (design fact 4a).

The redundant constraints are needed where measurements are few or contradict one another, and that is local: it
concerns a few of hundreds of frames. Write S for their rotations and T for all other variables. With the multipliers of
R'R = I kept for T, Z is positive definite exactly when Z_TT is, and the Schur complement too::

    Z_S = Z_SS - Z_ST Z_TT^-1 Z_TS,        P_S of Q in the same way

So the small dual is solved for Z_S in the measure P_S. S begins with the frames that the negative eigenvectors of Z in
the measure of Q reach. Where their multipliers are too few, S grows by the frames whose multipliers would raise t most:
the derivatives of t are known for every frame. Nothing here needs to be exact: `bound` gives a proof with any
multipliers. Z is used by products and a factor alone.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from rwhec_factors.se3 import so3_nearest

from gtsam_rwhec.files.progress import Progress
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.solver.answers import Evaluation
from gtsam_rwhec.solver.curvature import Curvature
from gtsam_rwhec.solver.part_form import PartForm
from gtsam_rwhec.solver.relaxation import round_to_rotations, solve_relaxation
from gtsam_rwhec.solver.rotations import CONSTRAINTS, multiplier_blocks, unvec, vec
from gtsam_rwhec.solver.small_dual import maximise, null_multipliers, scatter
from gtsam_rwhec.solver.solve_options import SolveOptions

#: This fraction of the diagonal of a frame's own translation and scale is added to it, where they are free.
FREE = 1e-9


def own_curvature(whole: PartForm, multipliers: Array) -> Array:
    """The smallest mu (n,) with Z v = mu Q v for vectors v of one frame alone. Where mu < 0, Z is surely negative."""
    own = whole.full.frames
    inner = own[:, :4, :4].copy()  # of translation and scale, made invertible
    diagonal = np.einsum("nii->ni", inner)
    diagonal[...] = (1.0 + FREE) * diagonal + (diagonal == 0.0)
    M = own[:, 4:, 4:] - np.matmul(own[:, 4:, :4], np.linalg.solve(inner, own[:, :4, 4:]))
    Lambda = multiplier_blocks(multipliers)[0][:, :9, :9]
    values, vectors = np.linalg.eigh(0.5 * (M + M.transpose(0, 2, 1)))
    root = vectors / np.sqrt(np.maximum(values, 1e-9 * np.abs(values).max(axis=1, initial=1e-290)[:, None]))[:, None, :]
    return 1.0 - np.linalg.eigvalsh(root.transpose(0, 2, 1) @ Lambda @ root)[:, -1]


#: Fractions of Q's diagonal that are added to Q and to Z, because translations and scales may be free.
OF_Q, OF_Z = 1e-9, 1e-12
#: Curvature below this part of Q's is negative, and not rounding.
NEGATIVE = -1e-6
#: A frame belongs to a direction when it has this part of the direction's squared length.
SHARE = 0.1
#: Number of the weakest directions that are computed at once.
DIRECTIONS = 20
#: S grows by the frames whose derivative of t is above ``PROMISE`` of the largest one, to at most ``GROWTH`` times its
#: size.
PROMISE, GROWTH = 0.02, 3
#: S has grown enough when a step has raised t by less than this part of it.
WORTH = 0.1


@dataclass(frozen=True)
class LocalForm:
    """Z and Q over [vec R of a few frames, h]: all other variables are eliminated."""

    frames: np.ndarray  #: (k,): their places among the part's free frames, ascending
    R: Array  #: (k, 3, 3): their rotations at the point
    kkt: Array  #: (k, 20): their multipliers in Z
    Z: Array  #: (9 k + 1, 9 k + 1); Z x = 0 at the point
    Q: Array
    #: (13 n + 1, 9 k + 1): how all variables follow [vec R of the frames, h] to keep Z smallest.
    follow: Array


@dataclass(frozen=True)
class LocalDual:
    """The result of the small dual of a few frames."""

    multipliers: Array  #: (n, 20), of all frames
    t: float  #: Z >= t Q at these multipliers; positive where they prove the point
    form: LocalForm | None  #: None where no form was found
    needed: int  #: how many frames S had at last, also where these were too many


def improve_locally(whole: PartForm, evaluation: Evaluation, kkt: Array, most: int) -> LocalDual:
    """Look for multipliers of all constraints that make Z positive definite, with at most ``most`` frames in S.

    ``kkt`` (n, 20) are the multipliers of R'R = I at the evaluated critical point. Z x stays zero.
    """
    diagonal = np.abs(whole.curvature.diagonal)
    Q = whole.curvature.plus(OF_Q * diagonal)
    Z = whole.curvature.less(kkt).plus(OF_Z * diagonal)
    best = LocalDual(kkt, -np.inf, None, 0)
    frames = weak_frames(whole, Q, Z, kkt, most)
    while 0 < len(frames) <= most:
        form = local_form(Q, Z, evaluation, kkt, frames)
        if form is None:
            break
        multipliers = kkt.copy()
        multipliers[frames], t = maximise(form.Z, form.Q, form.R, form.kkt)
        before = best.t
        if t > best.t:
            best = LocalDual(multipliers, t, form, len(frames))
        if t > 0.0 or not t - before > WORTH * abs(t):
            return best
        more = helpful_frames(whole, evaluation, form, multipliers[frames], t)
        if len(more) == 0:
            return best
        room = most - len(frames)
        if room == 0:
            return replace(best, needed=most + len(more))
        frames = np.union1d(frames, more[:room])
    return replace(best, needed=len(frames))


def rotation_rows(frames: np.ndarray) -> np.ndarray:
    """The places of the frames' rotations among the form's variables (9 k,)."""
    return (13 * frames[:, None] + np.arange(4, 13)).ravel()


def local_form(Q: Curvature, Z: Curvature, evaluation: Evaluation, kkt: Array, frames: np.ndarray) -> LocalForm | None:
    """The form of some frames; None where Z is not positive definite without them."""
    x = np.append(evaluation.point.numbers.ravel(), evaluation.point.alpha)
    Zx, Qx, g = Z.times(x), Q.times(x), evaluation.gradient
    of_Z = _eliminated(Z, frames, -Zx, float(x @ Zx))
    of_Q = _eliminated(Q, frames, g - Qx, max(evaluation.cost - 2.0 * float(x @ g) + float(x @ Qx), 0.0))
    if of_Z is None or of_Q is None:
        return None
    return LocalForm(frames, evaluation.point.rotations[frames], kkt[frames], of_Z[0], of_Q[0], of_Z[1])


def _eliminated(Z: Curvature, frames: np.ndarray, of_h: Array, of_hh: float) -> tuple[Array, Array] | None:
    """The Schur complement (9 k + 1 square) of [[Z, h], [h', hh]] on the frames' rotations and h, and what follows.

    None where the rest of Z is not positive definite.
    """
    rows = rotation_rows(frames)
    factor = Z.with_held(rows).factor()
    if factor is None:
        return None
    columns = np.column_stack([_columns(Z, frames), of_h])
    result = np.empty((len(rows) + 1,) * 2)
    result[:-1] = columns[rows]
    result[-1, :-1], result[-1, -1] = of_h[rows], of_hh
    columns[rows] = 0.0
    follow = -factor.solve(columns)
    follow[rows] = 0.0
    result += columns.T @ follow
    follow[rows, np.arange(len(rows))] = 1.0
    return 0.5 * (result + result.T), follow


def _columns(Z: Curvature, frames: np.ndarray) -> Array:
    """The columns of Z of the frames' rotations (13 n + 1, 9 k)."""
    matrix, k = Z.matrix, len(frames)
    n = len(matrix.frames)
    place = np.full(n, -1)
    place[frames] = np.arange(k)
    of_frames = np.zeros((n, k, 13, 9))
    of_frames[frames, np.arange(k)] = matrix.frames[frames][:, :, 4:]
    first, second = matrix.ends
    ends = np.flatnonzero(place[second] >= 0)
    of_frames[first[ends], place[second[ends]]] = matrix.couplings[ends][:, :, 4:]
    ends = np.flatnonzero(place[first] >= 0)
    of_frames[second[ends], place[first[ends]]] = matrix.couplings[ends].transpose(0, 2, 1)[:, :, 4:]
    tail = matrix.tails[frames][:, 4:].reshape(9 * k, -1).T
    return np.concatenate([of_frames.transpose(0, 2, 1, 3).reshape(13 * n, 9 * k), tail])


# -- which frames -------------------------------------------------------------------------------------------------


def weak_frames(whole: PartForm, Q: Curvature, Z: Curvature, kkt: Array, most: int) -> np.ndarray:
    """The frames that Z's negative directions reach; without them Z has none. It stops above ``most`` frames."""
    frames = np.flatnonzero(own_curvature(whole, kkt) < NEGATIVE)
    while len(frames) <= most:
        rows = rotation_rows(frames)
        mu, vectors = weakest_directions(Q.with_held(rows), Z.with_held(rows), DIRECTIONS)
        grown = np.union1d(frames, _frames_of(vectors[:, mu < NEGATIVE]))
        if len(grown) == len(frames):
            break
        frames = grown
    return frames


def weakest_directions(Q: Curvature, Z: Curvature, count: int) -> tuple[Array, Array]:
    """The smallest mu, ascending, and vectors (13 n + 1, count) with Z v = mu Q v: estimates.

    In this measure most of the spectrum is near 1, and and the negative directions are far below: Lanczos finds them in
    few steps.
    """
    from scipy.sparse.linalg import ArpackNoConvergence, LinearOperator, eigsh  # slow to import, few problems need it

    factor = Q.factor()
    if factor is None:
        return np.zeros(0), np.zeros((Q.size, 0))
    shape = (Q.size, Q.size)
    of_Z, of_Q, inverse = (
        LinearOperator(shape, matvec=product, dtype=np.float64) for product in (Z.times, Q.times, factor.solve_vector)
    )
    start = np.random.default_rng(0).standard_normal(Q.size)
    count = min(count, Q.size - 2)
    values: Array
    vectors: Array
    try:
        values, vectors = eigsh(of_Z, count, of_Q, Minv=inverse, which="SA", v0=start, tol=1e-2, maxiter=50)
    except ArpackNoConvergence as stopped:
        values, vectors = np.real(stopped.eigenvalues), np.real(stopped.eigenvectors)
    order = np.argsort(values)
    return values[order], vectors[:, order]


def _frames_of(vectors: Array) -> np.ndarray:
    """The frames whose rotations the directions (13 n + 1, k) reach."""
    n = len(vectors) // 13
    squares = (vectors[:-1].reshape(n, 13, -1)[:, 4:] ** 2).sum(axis=1)
    least = np.minimum(SHARE * squares.sum(axis=0), squares.max(axis=0, initial=0.0))  # the first frame in any case
    return np.flatnonzero((squares >= least).any(axis=1))


def helpful_frames(
    whole: PartForm, evaluation: Evaluation, form: LocalForm, multipliers: Array, t: float
) -> np.ndarray:
    """The frames outside of S whose multipliers would raise t most, the best first.

    With W = (Z_S - t P_S)^-1 the derivative of t by a multiplier of the matrix N of frame j is that of tr(N W_j), where
    W_j = F_j W F_j' and F_j maps the variables of S to the frame's variables. A multiplier may be as large as the
    frame's own curvature.
    """
    n, k = len(evaluation.point.numbers), len(form.frames)
    Z = form.Z - scatter(np.einsum("nk,kpq->npq", multipliers - form.kkt, CONSTRAINTS))
    below = t - 1e-2 * abs(t) - 1e-9
    P = form.Q + 1e-9 * np.diag(np.abs(np.diagonal(form.Q)) + np.abs(np.diagonal(form.Z)).max())
    values, vectors = np.linalg.eigh(Z - below * P)
    W = (vectors / np.maximum(np.abs(values), 1e-12 * np.abs(values).max())) @ vectors.T
    follow = np.zeros((n, 10, 9 * k + 1))
    follow[:, :9] = form.follow[:-1].reshape(n, 13, -1)[:, 4:]
    follow[:, 9, -1] = 1.0
    blocks = np.matmul(np.matmul(follow, W), follow.transpose(0, 2, 1))
    by_constraint = np.einsum("kpq,npq->nk", CONSTRAINTS, blocks)
    slopes = np.einsum("nmk,nk->nm", null_multipliers(evaluation.point.rotations), by_constraint)
    own = np.abs(whole.curvature.diagonal)[:-1].reshape(n, 13)[:, 4:].min(axis=1)
    promise = own * np.linalg.norm(slopes, axis=1)
    promise[form.frames] = 0.0
    order = np.argsort(-promise)[: (GROWTH - 1) * max(k, 3)]
    result: np.ndarray = order[promise[order] > PROMISE * promise.max()]
    return result


@dataclass(frozen=True)
class LocalRelaxation:
    """A solution of the relaxation of a few frames, up to the solver's accuracy."""

    multipliers: Array  #: (n, 20), of all frames
    dual: float  #: its optimum: no answer costs less
    starts: list[Array]  #: rotations (n, 3, 3) of all frames


def relax_locally(
    evaluation: Evaluation, kkt: Array, form: LocalForm, options: SolveOptions, progress: Progress | None = None
) -> LocalRelaxation:
    """Solve the relaxation of the frames of ``form``; ``kkt`` (n, 20): R'R = I's multipliers at the evaluated point."""
    Q = form.Z + scatter(np.einsum("nk,kpq->npq", form.kkt, CONSTRAINTS))
    Q[-1, -1] += evaluation.cost  # Z has it taken off, so that Z x = 0
    relaxation = solve_relaxation(Q, options.relaxation_tolerance, options.max_relaxation_iterations, progress)
    multipliers = kkt.copy()
    multipliers[form.frames] = relaxation.multipliers
    starts = []
    for R in round_to_rotations(relaxation):
        followed = form.follow @ np.append(vec(R).ravel(), 1.0)
        starts.append(so3_nearest(unvec(followed[:-1].reshape(-1, 13)[:, 4:])))
    return LocalRelaxation(multipliers, relaxation.dual, starts)
