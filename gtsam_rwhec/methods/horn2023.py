"""Horn, Wodtko, Buchholz and Dietmayer 2023: unit dual quaternions, a quadratic problem with its own relaxation.

A pose is the dual quaternion p + eps p', p' = t p / 2. The residual a x - y b is then linear in x and y, and the cost
is a quadratic form z'Qz over z = [p_X, p_X', ..., p_Y, p_Y', ...]. Each frame has two constraints, |p| = 1 and
<p, p'> = 0.

**Signs.** Each measured rotation has two unit quaternions. The sign of a x - y b as a whole has no effect. The sign of
b relative to a has one: a measurement with the wrong sign asks for the opposite of x and y. N measurements give 2^N
problems, and only one is right. ``Signs`` names the ways to choose; the answer counts the signs that it contradicts.
The relaxation is tight with wrong signs too: its certificate then proves the optimum of the wrong problem (design
fact 19).

In the RWHEC paper's Section 8.2 (four cameras, 108 poses, released noise) continuous signs fail in 2 of 100 runs at
kappa = 12 (measured: 6 of 300) and in none of 300 at kappa = 125. A failed run ends about 40 degrees and half a metre
away; a few such runs make the paper's 69 +- 121 mm. Signs of nonnegative scalars fail in every run there, and in
Section 8.1.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Literal, get_args

import clarabel
import numpy as np
import scipy.sparse
from scipy.linalg import block_diag

from gtsam_rwhec.errors import OptionError
from gtsam_rwhec.geometry.blas_threads import one_blas_thread
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.geometry.quaternions import conjugate, dual_parts, left, of_rotations, of_vectors, right, to_rotations
from gtsam_rwhec.methods.levenberg_marquardt import descend_on_chart, unit_quaternions
from gtsam_rwhec.methods.linear_systems import Stack, agreement, paired_quaternions
from gtsam_rwhec.methods.method import UNWEIGHTED, Method, MethodOptions, Outcome, Poses, Properties
from gtsam_rwhec.problem.problem import Problem
from gtsam_rwhec.solver.relaxation import solve_conic, stacked, unstacked

#: The relaxation is solved for at most this many frames. A cone of 8 n takes a dense block of order 4 n (8 n + 1)
#: squared.
MOST_FRAMES = 10
#: The interior-point solver stops at this relative gap and infeasibility.
TOLERANCE = 1e-10
#: The interior-point solver and the descent stop after these numbers of steps in any case.
STEPS, DESCENT_STEPS = 200, 1000


def relaxed(Q: Array, frames: int) -> tuple[Array, Array, float]:
    """Solve the relaxation of Q (8 n, 8 n): the nearest p (n, 4) and t (n, 3), metres, and the solver's lower bound.

    Beyond ``MOST_FRAMES`` the smallest eigenvector replaces the answer, and the lower bound is 0.
    """
    if frames > MOST_FRAMES:
        return *rounded(_smallest_eigenvector(Q), frames), 0.0
    size = 8 * frames
    scale = float(np.abs(Q).max()) or 1.0
    frame, entry = np.repeat(np.arange(frames), 4), np.tile(np.arange(4), frames)
    primal, dual = 8 * frame + entry, 8 * frame + entry + 4
    rows = np.concatenate([primal * (primal + 1) // 2 + primal, dual * (dual + 1) // 2 + primal])
    columns = np.concatenate([2 * frame, 2 * frame + 1])
    values = np.concatenate([np.ones(4 * frames), np.full(4 * frames, np.sqrt(2.0))])
    A = scipy.sparse.csc_matrix((values, (rows, columns)), (size * (size + 1) // 2, 2 * frames))
    cost, cones = np.tile([-1.0, 0.0], frames), [clarabel.PSDTriangleConeT(size)]
    multipliers, z, _ = solve_conic(cost, A, stacked(Q / scale), cones, TOLERANCE, STEPS)
    return *rounded(np.linalg.eigh(unstacked(z, size))[1][:, -1], frames), scale * float(multipliers[::2].sum())


def _smallest_eigenvector(Q: Array) -> Array:
    """The smallest eigenvector of Q without its dual parts, which have no length of their own, then the dual parts."""
    blocks = Q.reshape(-1, 2, 4, len(Q) // 8, 2, 4)
    half = len(Q) // 2
    pp, pd, dd = (blocks[:, a, :, :, b, :].reshape(half, half) for a, b in ((0, 0), (0, 1), (1, 1)))
    to_dual = -np.linalg.lstsq(dd, pd.T, rcond=1e-12)[0]
    p = np.linalg.eigh(pp + pd @ to_dual)[1][:, 0]
    return np.stack([p.reshape(-1, 4), (to_dual @ p).reshape(-1, 4)], axis=1).ravel()


def rounded(z: Array, frames: int) -> tuple[Array, Array]:
    """Unit quaternions (n, 4) and t (n, 3) of z: each frame is divided by |p|, its dual part made orthogonal to p."""
    parts = z.reshape(frames, 2, 4)
    lengths = np.linalg.norm(parts[:, 0], axis=1)[:, None]
    q, dual = parts[:, 0] / lengths, parts[:, 1] / lengths
    t: Array = 2.0 * np.einsum("nij,ni->nj", right(q), dual)[:, :3]  # t p = 2 p'
    return q, t


def vector_of(q: Array, t: Array) -> Array:
    """z (8 n,) of unit quaternions and translations."""
    return np.stack([q, dual_parts(q, t)], axis=1).ravel()


def polished(Q: Array, q: Array, t: Array) -> tuple[Array, Array, float]:
    """The local minimum of z'Qz near p (n, 4) and t (n, 3): p, t and the cost."""
    start = np.concatenate([q, t], axis=1).ravel()
    found = descend_on_chart(Q, pose_chart, start, DESCENT_STEPS).reshape(-1, 7)
    (q, _), t = unit_quaternions(found[:, :4]), found[:, 4:]
    z = vector_of(q, t)
    return q, t, float(z @ Q @ z)


def pose_chart(p: Array) -> tuple[Array, Array]:
    """z (8 n,) of 7 numbers a frame, a quaternion of any length and t in metres, and its derivatives (8 n, 7 n)."""
    frames = p.reshape(-1, 7)
    (q, by_quaternion), t = unit_quaternions(frames[:, :4]), frames[:, 4:]
    n, at = len(frames), np.arange(len(frames))
    derivatives = np.zeros((n, 8, n, 7))
    derivatives[at, :4, at, :4] = by_quaternion
    derivatives[at, 4:, at, :4] = 0.5 * left(of_vectors(t)) @ by_quaternion  # p' = t p / 2
    derivatives[at, 4:, at, 4:] = 0.5 * right(q)[:, :, :3]
    return vector_of(q, t), derivatives.reshape(8 * n, 7 * n)


def multipliers_of(Q: Array, q: Array, t: Array) -> tuple[float, float]:
    """The sum of lambda_i at a critical point, and Z's smallest eigenvalue; the sum is a bound where Z >= 0.

    From Q z = blkdiag z: lambda_i p + mu_i p' = (Qz)_p and mu_i p = (Qz)_p'.
    """
    n = len(q)
    z = vector_of(q, t)
    g = (Q @ z).reshape(n, 2, 4)
    dual = z.reshape(n, 2, 4)[:, 1]
    mu = np.einsum("ni,ni->n", g[:, 1], q)
    lam = np.einsum("ni,ni->n", g[:, 0] - mu[:, None] * dual, q)
    blocks = [np.kron([[own, mixed], [mixed, 0.0]], np.eye(4)) for own, mixed in zip(lam, mu, strict=True)]
    return float(lam.sum()), float(np.linalg.eigvalsh(Q - block_diag(*blocks))[0])


#: How the quaternions of A and B get their signs.
#:
#: "aligned": the signs that the answer satisfies. A rotation estimate without signs chooses first, then the answer.
#: "continuous": each quaternion is near to the one before it, for A and for B separately. Right for smooth paths.
#: "scalar": no scalar part is negative, as in many conversions from matrices.
#: "random": drawn with the seed.
Signs = Literal["aligned", "continuous", "scalar", "random"]
#: The residual that is squared. A product with a dual quaternion changes the norm, so "a x - y b" and "x - a* y b" are
#: different costs. The RWHEC paper's rows "Horn" have the second.
Residual = Literal["a x - y b", "x - a* y b"]
#: The relaxation's bound proves the answer up to this relative gap, which remains at its solver's tolerance.
CLOSED = 1e-6
#: Signs are chosen by the answer in at most this many rounds.
ROUNDS = 10
#: A measurement's sign cannot be told when its residual has at least this angle, degrees.
UNCERTAIN_DEG = 150.0


@dataclass(frozen=True)
class DualQuaternionAnswer:
    """The answer for one choice of signs: R (n, 3, 3) and t (n, 3) of all targets, then of all sensors; metres.

    ``cost`` is z'Qz with these signs (other signs have other costs), ``lower_bound`` what no z goes below, by the
    relaxation's multipliers. ``signs`` (N,) are those of <p_a, p_b> relative to the quaternions of ``of_rotations``:
    two choices of signs can be compared by them. ``contradicted`` counts the measurements whose sign the answer
    contradicts; the common sign of a pair is free. ``smallest_margin`` is the least |<p_a p_x, p_y p_b>|, the cosine of
    half the residual's angle: near zero the sign cannot be told.
    """

    R: Array
    t: Array
    cost: float
    lower_bound: float
    signs: Array
    contradicted: int
    smallest_margin: float

    @property
    def gap(self) -> float:
        """Between cost and bound, relative to the cost."""
        return (self.cost - self.lower_bound) / max(self.cost, 1e-300)


def horn2023(problem: Problem, options: MethodOptions, signs: Signs = "aligned") -> Outcome[Poses]:
    """Solve for several Xs or several Ys of known scale."""
    stack = Stack.of(problem)
    found = solve_dual_quaternions(stack, signs, options.seed)
    notes = [f"relative gap to the bound of its own relaxation: {found.gap:.1e}"]
    if found.contradicted:
        notes.append(
            f"{found.contradicted} of {len(stack.A)} signs (signs={signs!r}) contradict the answer: another choice of "
            "signs has a better answer"
        )
    if found.smallest_margin < np.cos(0.5 * np.radians(UNCERTAIN_DEG)):
        notes.append(f"a residual is larger than {UNCERTAIN_DEG:g} degrees: the measurement's sign cannot be told")
    return replace(
        stack.outcome(found.R, found.t, notes=notes),
        cost=found.cost,
        cost_name="|a x - y b|^2 of dual quaternions, with the signs chosen",
        lower_bound=found.lower_bound,
        is_optimal=found.contradicted == 0 and found.gap <= CLOSED,
    )


@one_blas_thread()
def solve_dual_quaternions(
    stack: Stack, signs: Signs = "aligned", seed: int = 0, residual: Residual = "a x - y b"
) -> DualQuaternionAnswer:
    """The global optimum of Horn's cost for a choice of signs; "random" signs are drawn with the seed.

    Raises OptionError when ``signs`` or ``residual`` is not one of the choices, and UnderdeterminedError when the
    rotations are not determined ("aligned" finds them first).
    """
    q_A, q_B = signed_quaternions(stack, signs, seed)
    rows_X, rows_Y = residual_rows(stack, q_A, q_B, residual)
    fitting = np.ones(len(q_B))
    for _ in range(ROUNDS if signs == "aligned" else 1):
        sign = fitting
        Q = form_of(stack, rows_X, sign[:, None, None] * rows_Y)
        q, t, bound = relaxed(Q, len(Q) // 8)
        q, t, cost = polished(Q, q, t)
        products = agreement(q_A, q[stack.target], q[stack.sensor], q_B)
        # The common sign of a pair belongs to its frames.
        whole = np.sign(stack.sums(sign * products))[np.repeat(np.arange(len(stack.pairs)), stack.counts)]
        fitting = np.where(whole * products < 0.0, -1.0, 1.0)
        contradicted = int(np.count_nonzero(whole * sign * products < 0.0))
        if contradicted == 0:
            break
    plain_A, plain_B = of_rotations(stack.A[:, :3, :3]), of_rotations(stack.B[:, :3, :3])
    reference = np.sign(np.einsum("ni,ni->n", plain_A, q_A) * np.einsum("ni,ni->n", plain_B, q_B))
    return DualQuaternionAnswer(
        to_rotations(q),
        t,
        max(cost, 0.0),
        _bound(Q, q, t, cost, bound),
        sign * reference,
        contradicted,
        float(np.abs(products).min()),
    )


def signed_quaternions(stack: Stack, signs: Signs, seed: int) -> tuple[Array, Array]:
    """q_A and q_B (N, 4), scalar last, with a choice of signs; raises OptionError for another choice."""
    if signs == "aligned":
        return paired_quaternions(stack)
    q_A, q_B = of_rotations(stack.A[:, :3, :3]), of_rotations(stack.B[:, :3, :3])
    if signs == "scalar":
        return np.where(q_A[:, 3:] < 0.0, -q_A, q_A), np.where(q_B[:, 3:] < 0.0, -q_B, q_B)
    if signs == "continuous":
        return _continuous(q_A, stack.first), _continuous(q_B, stack.first)
    if signs == "random":
        return q_A, np.random.default_rng(seed).choice([-1.0, 1.0], (len(q_B), 1)) * q_B
    raise OptionError(f"signs={signs!r} is not one of {', '.join(map(repr, get_args(Signs)))}")


def _continuous(q: Array, first: np.ndarray) -> Array:
    """The quaternions (N, 4) with signs that bring each near to the quaternion before it, pair by pair."""
    steps = np.ones(len(q))
    steps[1:] = np.where(np.einsum("ni,ni->n", q[1:], q[:-1]) < 0.0, -1.0, 1.0)
    steps[first[:-1]] = 1.0
    running = np.cumprod(steps)
    signed: Array = (running * np.repeat(running[first[:-1]], np.diff(first)))[:, None] * q
    return signed


def residual_rows(stack: Stack, q_A: Array, q_B: Array, residual: Residual = "a x - y b") -> tuple[Array, Array]:
    """M_X and M_Y (N, 8, 8): each measurement's residual is M_X z_X - M_Y z_Y; OptionError for another residual."""
    if residual not in get_args(Residual):
        raise OptionError(f"residual={residual!r} is not one of {', '.join(map(repr, get_args(Residual)))}")
    of_Y = _multiplication(q_B, stack.B[:, :3, 3], right)
    if residual == "a x - y b":
        return _multiplication(q_A, stack.A[:, :3, 3], left), of_Y
    t_inverse = -np.einsum("nji,nj->ni", stack.A[:, :3, :3], stack.A[:, :3, 3])
    return np.tile(np.eye(8), (len(of_Y), 1, 1)), _multiplication(conjugate(q_A), t_inverse, left) @ of_Y


def form_of(stack: Stack, rows_X: Array, rows_Y: Array) -> Array:
    """Q (8 n, 8 n): z'Qz is the sum of the squared residuals M_X z_X - M_Y z_Y."""
    size = 8 * len(stack.names)
    Q = np.zeros((size, size))
    for (j, k), of_X, of_Y in zip(stack.pairs, stack.by_pair(rows_X), stack.by_pair(rows_Y), strict=True):
        rows = np.concatenate([of_X.reshape(-1, 8), -of_Y.reshape(-1, 8)], axis=1)
        at = np.r_[8 * j : 8 * j + 8, 8 * k : 8 * k + 8]
        Q[np.ix_(at, at)] += rows.T @ rows
    return Q


def _multiplication(q: Array, t: Array, side: Callable[[Array], Array]) -> Array:
    """(N, 8, 8): dual quaternion multiplication by q + eps t q / 2, from the left or from the right."""
    result = np.zeros((len(q), 8, 8))
    result[:, :4, :4] = result[:, 4:, 4:] = side(q)
    result[:, 4:, :4] = side(dual_parts(q, t))
    return result


def _bound(Q: Array, q: Array, t: Array, cost: float, bound: float) -> float:
    """The bound of the multipliers at the answer; if they prove nothing, the solver's, exact to its tolerance."""
    value, smallest = multipliers_of(Q, q, t)
    if smallest >= -1e-13 * len(Q) * float(np.abs(Q).max()):
        return min(value, cost)
    return min(bound, cost)


HORN = Method(
    name="horn2023",
    properties=Properties("dual quaternions", certifiable=True, multiple="Xs or Ys"),
    source="M. Horn, T. Wodtko, M. Buchholz and K. Dietmayer, Extrinsic infrastructure calibration using the hand-eye "
    "robot-world formulation, IEEE Intelligent Vehicles Symposium 2023",
    assumes=f"{UNWEIGHTED} The cost changes with the origins of the carriers' frames. Signs of quaternions must fit; "
    "large rotation errors make them uncertain.",
    function=horn2023,
)
