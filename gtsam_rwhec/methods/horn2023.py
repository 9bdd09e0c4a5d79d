"""Horn, Wodtko, Buchholz and Dietmayer 2023: unit dual quaternions, a quadratic problem with its own relaxation.

With poses as dual quaternions, p + eps p', p' = t p / 2, the residual a x - y b is linear in x and y, and the cost a
quadratic form z'Qz over z = [p_X, p_X', ..., p_Y, p_Y', ...]. Each frame has two constraints, |p| = 1 and <p, p'> = 0.

**Signs.** Each measured rotation has two unit quaternions. The sign of a x - y b as a whole means nothing, that of b
against a does: a measurement whose sign is wrong asks for the opposite of x and y, and there are 2^N problems of N
measurements, of which one is meant. ``Signs`` are the ways to choose; what is wrong with them is counted in the answer.
The relaxation is tight with wrong signs too: its certificate then proves the optimum of the wrong problem.

In the RWHEC paper's Section 8.2 (four cameras, 108 poses, its released noise) continuous signs are lost in 2 runs of
100 at kappa = 12 (6 of 300 measured; such a run ends about 40 degrees and half a metre away, and a few of them make the
paper's 69 +- 121 mm), and in none of 300 at kappa = 125. Signs of nonnegative scalars fail in every run there, and in
Section 8.1's.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Literal, get_args

import numpy as np

from gtsam_rwhec.errors import OptionError
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.geometry.quaternions import conjugate, dual_parts, left, of_rotations, right, to_rotations
from gtsam_rwhec.methods.absolute import Stack
from gtsam_rwhec.methods.dual_quaternion_relaxation import Relaxed, multipliers_of, polished, relaxed
from gtsam_rwhec.methods.estimate import Outcome, Poses
from gtsam_rwhec.methods.method import Method, MethodOptions, Properties
from gtsam_rwhec.methods.paired_quaternions import agreement, paired_quaternions
from gtsam_rwhec.problem.problem import Problem

#: How the quaternions of A and B get their signs.
#:
#: "aligned": those that the answer satisfies, from a rotation estimate without signs and then from the answer itself.
#: "continuous": of A and of B apart, each nearer to the one before it than its opposite: right for smooth paths.
#: "scalar": no scalar part is negative, as many conversions from matrices have it.
#: "random": by the seed.
Signs = Literal["aligned", "continuous", "scalar", "random"]
#: What is squared. Multiplying by a dual quaternion changes the norm, so these are different costs: "a x - y b", or
#: "x - a* y b", X against what each measurement makes of Y. The RWHEC paper's rows "Horn" are those of the second.
Residual = Literal["a x - y b", "x - a* y b"]
#: A relative gap up to which the relaxation's bound proves the answer: what its solver's tolerance leaves.
CLOSED = 1e-6
#: Rounds of choosing signs by the answer.
ROUNDS = 10
#: A quarter of a squared metre is what the dual part makes of a unit translation; beside it a rotation of an angle
#: counts a quarter of its square.
DUAL_WEIGHT = 1.0


@dataclass(frozen=True)
class DualQuaternionAnswer:
    """Of one choice of signs.

    Attributes
    ----------
    R, t : (n, 3, 3) and (n, 3) arrays
        All targets' frames, then all sensors'; metres.
    cost, lower_bound : float
        z'Qz, and what no z goes below with these signs, by the relaxation's multipliers. The cost is of these signs'
        problem: it says nothing of the others'.
    signs : (N,) array
        Of each measurement's <p_a, p_b> times that of the quaternions with which ``of_rotations`` answers:
        two choices of signs can be compared by it, whatever the signs of a and b apart.
    contradicted : int
        Measurements whose sign the answer itself contradicts, the one that fits the frame as a whole being free.
    smallest_margin : float
        The least |<p_a p_x, p_y p_b>|, the cosine of half the residual's angle: near zero a sign cannot be told.
    rounds : int
        Relaxations solved.
    """

    R: Array
    t: Array
    cost: float
    lower_bound: float
    signs: Array
    contradicted: int
    smallest_margin: float
    rounds: int

    @property
    def gap(self) -> float:
        """Between cost and bound, relative to the cost."""
        return (self.cost - self.lower_bound) / max(self.cost, 1e-300)


def horn2023(problem: Problem, options: MethodOptions, signs: Signs = "aligned") -> Outcome[Poses]:
    """Several Xs or several Ys, known scale."""
    stack = Stack.of(problem)
    found = solve_dual_quaternions(stack, signs, options.seed)
    n_X = len(stack.targets)
    notes = [f"relative gap to the bound of its own relaxation: {found.gap:.1e}"]
    if found.contradicted:
        notes.append(
            f"{found.contradicted} of {len(stack.A)} signs (signs={signs!r}) contradict the answer: another choice of "
            "signs has a better one"
        )
    if found.smallest_margin < np.cos(0.5 * np.radians(150.0)):
        notes.append("a measurement is off by more than 150 degrees: its sign cannot be told")
    outcome = stack.outcome(found.R[:n_X], found.t[:n_X], found.R[n_X:], found.t[n_X:], notes=notes)
    return replace(
        outcome,
        cost=found.cost,
        cost_name="|a x - y b|^2 of dual quaternions, with the signs chosen",
        lower_bound=found.lower_bound,
        is_optimal=found.contradicted == 0 and found.gap <= CLOSED,
    )


def solve_dual_quaternions(
    stack: Stack,
    signs: Signs = "aligned",
    seed: int = 0,
    dual_weight: float = DUAL_WEIGHT,
    residual: Residual = "a x - y b",
) -> DualQuaternionAnswer:
    """The global optimum of Horn's cost for a choice of signs.

    Parameters
    ----------
    stack : Stack
    signs : "aligned", "continuous", "scalar" or "random"
    seed : int
        Of "random".
    dual_weight : float
        Of the dual part's square against the primal part's.
    residual : "a x - y b" or "x - a* y b"

    Raises
    ------
    OptionError
        For another choice of signs, or another residual.
    UnderdeterminedError
        When the rotations are not determined (by "aligned", which looks at them first).
    """
    q_A, q_B = signed_quaternions(stack, signs, seed)
    form = _Form.of(stack, q_A, q_B, dual_weight, residual)
    sign = np.ones(len(q_B))
    rounds = 0
    while True:
        rounds += 1
        Q = form.matrix(sign)
        found = relaxed(Q, form.frames)
        q, t, cost = polished(Q, found.q, found.t)
        products = agreement(q_A, q[stack.target], q[len(stack.targets) + stack.sensor], q_B)
        # Each pair's sign as a whole is the frames' own.
        whole = np.sign(stack.sums(sign * products))[np.repeat(np.arange(len(stack.pairs)), stack.counts)]
        contradicted = int(np.count_nonzero(whole * sign * products < 0.0))
        if signs != "aligned" or contradicted == 0 or rounds == ROUNDS:
            break
        sign = np.where(whole * products < 0.0, -1.0, 1.0)
    return DualQuaternionAnswer(
        to_rotations(q),
        t,
        max(cost, 0.0),
        _bound(Q, q, t, cost, found),
        sign * _reference_signs(q_A, q_B, stack),
        contradicted,
        float(np.abs(products).min()),
        rounds,
    )


def signed_quaternions(stack: Stack, signs: Signs, seed: int) -> tuple[Array, Array]:
    """q_A and q_B (N, 4), scalar last, with a choice of signs.

    Raises
    ------
    OptionError
    """
    if signs == "aligned":
        return paired_quaternions(stack)
    q_A, q_B = of_rotations(stack.A[:, :3, :3]), of_rotations(stack.B[:, :3, :3])
    if signs == "scalar":
        return _with(np.where(q_A[:, 3] < 0.0, -1.0, 1.0), q_A), _with(np.where(q_B[:, 3] < 0.0, -1.0, 1.0), q_B)
    if signs == "continuous":
        return _with(_continuous(q_A, stack.first), q_A), _with(_continuous(q_B, stack.first), q_B)
    if signs == "random":
        generator = np.random.default_rng(seed)
        return q_A, _with(generator.choice([-1.0, 1.0], len(q_B)), q_B)
    raise OptionError(f"signs={signs!r} is not one of 'aligned', 'continuous', 'scalar', 'random'")


def _with(sign: Array, q: Array) -> Array:
    return sign[:, None] * q


def _continuous(q: Array, first: np.ndarray) -> Array:
    """Signs (N,) with which each quaternion is nearest to the one before, pair by pair."""
    steps = np.ones(len(q))
    steps[1:] = np.where(np.einsum("ni,ni->n", q[1:], q[:-1]) < 0.0, -1.0, 1.0)
    steps[first[:-1]] = 1.0
    running: Array = np.cumprod(steps)
    starts = running[first[:-1]]
    result: Array = running * np.repeat(starts, np.diff(first))
    return result


def _reference_signs(q_A: Array, q_B: Array, stack: Stack) -> Array:
    """Of the quaternions' signs together, against those of the plain conversion from matrices."""
    plain_A, plain_B = of_rotations(stack.A[:, :3, :3]), of_rotations(stack.B[:, :3, :3])
    result: Array = np.sign(np.einsum("ni,ni->n", plain_A, q_A) * np.einsum("ni,ni->n", plain_B, q_B))
    return result


@dataclass(frozen=True)
class _Form:
    """Each pair's 16 x 16 matrix of |a x - y b|^2; only its off-diagonal block knows signs, so rows are kept for it."""

    frames: int
    own_X: Array
    own_Y: Array
    rows_X: Array
    rows_Y: Array
    stack: Stack

    @staticmethod
    def of(stack: Stack, q_A: Array, q_B: Array, dual_weight: float, residual: Residual = "a x - y b") -> _Form:
        if residual not in get_args(Residual):
            raise OptionError(f"residual={residual!r} is not one of {', '.join(map(repr, get_args(Residual)))}")
        weight = np.repeat([1.0, np.sqrt(dual_weight)], 4)[:, None]
        rows_Y = _multiplication(q_B, stack.B[:, :3, 3], right)
        if residual == "a x - y b":
            rows_X = weight * _multiplication(q_A, stack.A[:, :3, 3], left)
            rows_Y = weight * rows_Y
        else:
            t_inverse = -np.einsum("nji,nj->ni", stack.A[:, :3, :3], stack.A[:, :3, 3])
            rows_X = np.tile(weight * np.eye(8), (len(stack.A), 1, 1))
            rows_Y = weight * (_multiplication(conjugate(q_A), t_inverse, left) @ rows_Y)
        edges = [slice(8 * i, 8 * j) for i, j in zip(stack.first[:-1], stack.first[1:], strict=True)]
        flat_X, flat_Y = rows_X.reshape(-1, 8), rows_Y.reshape(-1, 8)
        own_X = np.array([flat_X[edge].T @ flat_X[edge] for edge in edges])
        own_Y = np.array([flat_Y[edge].T @ flat_Y[edge] for edge in edges])
        return _Form(len(stack.targets) + len(stack.sensors), own_X, own_Y, flat_X, flat_Y, stack)

    def matrix(self, sign: Array) -> Array:
        """Q (8 n, 8 n) with a sign (N,) for each b."""
        n_X = len(self.stack.targets)
        Q = np.zeros((self.frames, 8, self.frames, 8))
        signed = np.repeat(sign, 8)[:, None] * self.rows_Y
        for e, (j, k) in enumerate(self.stack.pairs):
            rows = slice(8 * self.stack.first[e], 8 * self.stack.first[e + 1])
            cross = self.rows_X[rows].T @ signed[rows]
            Q[j, :, j] += self.own_X[e]
            Q[n_X + k, :, n_X + k] += self.own_Y[e]
            Q[j, :, n_X + k] -= cross
            Q[n_X + k, :, j] -= cross.T
        return Q.reshape(8 * self.frames, 8 * self.frames)


def _multiplication(q: Array, t: Array, side: Callable[[Array], Array]) -> Array:
    """(N, 8, 8): dual quaternion multiplication by q + eps t q / 2, from the left or from the right."""
    result = np.zeros((len(q), 8, 8))
    result[:, :4, :4] = result[:, 4:, 4:] = side(q)
    result[:, 4:, :4] = side(dual_parts(q, t))
    return result


def _bound(Q: Array, q: Array, t: Array, cost: float, found: Relaxed) -> float:
    """By the multipliers at the polished answer; where those do not prove it, the solver's, true to its tolerance."""
    value, smallest = multipliers_of(Q, q, t)
    if smallest >= -1e-13 * len(Q) * float(np.abs(Q).max()):
        return min(value, cost)
    return min(found.lower_bound, cost)


METHOD = Method(
    name="horn2023",
    properties=Properties("dual quaternions", certifiable=True, multiple="Xs or Ys"),
    source="M. Horn, T. Wodtko, M. Buchholz and K. Dietmayer, Extrinsic infrastructure calibration using the hand-eye "
    "robot-world formulation, IEEE Intelligent Vehicles Symposium 2023",
    assumes="Errors alike in all measurements, a radian as bad as a metre; a cost that changes with the origins of the "
    "carriers' frames; signs of the quaternions that fit together, which large rotation errors make uncertain.",
    function=horn2023,
)
