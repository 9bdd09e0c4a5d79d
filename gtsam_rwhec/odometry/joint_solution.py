"""The global optimum of the joint form, and its proof: multipliers at the answer, a bound by Cholesky.

As in the solver (design facts 3 and 4): at a critical point the multipliers of R'R = I are known; if they do not
suffice, those of all constraints are searched, and then the semidefinite relaxation gives both a start and multipliers.
The proof is about all variables. With Z = Q - Lambda on all but the constant, y = x + d and g = Z's gradient at x,

    J(y) >= J(x) + c + 2 g'd + d'Z d >= J(x) + c - g'g / mu     if Z >= mu > 0 is proven (the diagonal scaled to one),

where c is what the rounding of x leaves of the constraints. Where Z is not positive definite up to rounding, d is
limited: entries of rotations by themselves, translations by a region.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from gtsam_rwhec.errors import ScaleError
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.odometry.found import JointCertificate
from gtsam_rwhec.odometry.joint_form import JointForm
from gtsam_rwhec.solver.certificate import Status
from gtsam_rwhec.solver.descent import Descent, descend, homogeneous
from gtsam_rwhec.solver.relaxation import round_to_rotations, solve_by_blocks
from gtsam_rwhec.solver.rotations import CONSTRAINTS, constraint_values, kkt_multipliers, random_rotations
from gtsam_rwhec.solver.small_dual import improve, scatter, stationary_multipliers

#: Descents from so many random rotations, beside the given starts.
RANDOM_STARTS = 4
#: Newton's steps of a descent.
MAX_DESCENT = 100
#: The relaxation is solved for at most so many sensors (beside the reference).
MAX_RELAXED = 60
#: Where the best answer is a mirror image, scales are held to this part of themselves, so often that they settle.
SCALE_SHARE, SCALE_ROUNDS = 0.1, 3
#: Positive scales may cost so many times what the mirror image does.
MIRRORED_COST = 1.5
#: Where a proof needs a region, translations are limited to so many metres along each axis.
REGION_M = 1000.0
#: The gap that counts as none, of a cost that is half a chi-square (design fact 10).
TOLERANCE = 1e-6


@dataclass(frozen=True)
class JointSolution:
    """The answer y (d,) of a joint form and its certificate; whether it is unique is not asked here."""

    y: Array
    certificate: JointCertificate


def solved(form: JointForm, starts: list[Array], *, axis: Array | None = None) -> JointSolution:
    """The best answer of descents from rotations (K, 3, 3), with the best bound that was found for it.

    An answer with a negative scale is the mirror image of one with a positive scale (design fact 5), which costs about
    as much if the vehicle turned about one ``axis`` (3,). It is turned about that axis by half a turn, and found and
    proven again with the scales held near (``SCALE_SHARE``).

    Raises
    ------
    ScaleError
        With positive scales the cost is far above that of the mirror image.
    """
    generator = np.random.default_rng(0)
    starts = starts + [random_rotations(form.sensors, generator) for _ in range(RANDOM_STARTS)]
    best, y, certificate = _best(form, starts)
    negative = y[12 * form.sensors : -1] < 0.0
    if axis is None or not negative.any():
        return JointSolution(y, certificate)
    R = best.R.copy()
    R[form.scaled[negative]] = (2.0 * np.outer(axis, axis) - np.eye(3)) @ R[form.scaled[negative]]
    scale = np.ones(form.sensors)
    scale[form.scaled] = np.abs(y[12 * form.sensors : -1])
    for _ in range(SCALE_ROUNDS):
        held = form.with_scales_near(scale, SCALE_SHARE)
        R = descend(held.reduced, R, MAX_DESCENT).R
        scale[form.scaled] = np.abs(held.completed(homogeneous(R))[12 * form.sensors : -1])
    _, y, with_positive = _best(held, [R])
    if with_positive.cost > MIRRORED_COST * certificate.cost + 100.0:
        raise ScaleError(
            f"the joint cost is {certificate.cost:.4g} with a negative scale and {with_positive.cost:.4g} with "
            "positive ones: the motion of a sensor of unknown scale is the mirror image of the others'; are its poses "
            "inverted, or its axes left-handed?"
        )
    return JointSolution(y, replace(with_positive, scales_held=True))


def _best(form: JointForm, starts: list[Array]) -> tuple[Descent, Array, JointCertificate]:
    """The lowest end of the descents, its y (d,), and the highest bound."""
    reduced = form.reduced
    best = min((descend(reduced, R, MAX_DESCENT) for R in starts), key=lambda end: end.cost)
    y, certificate = _proven(form, best)
    if certificate.is_optimal or form.sensors > MAX_RELAXED:
        return best, y, certificate
    relaxation = solve_by_blocks(reduced.Q, 1e-9, 100)
    ends = [descend(reduced, R, MAX_DESCENT) for R in round_to_rotations(relaxation)]
    best = min([best, *ends], key=lambda end: end.cost)
    more = stationary_multipliers(_gradient(reduced.apply(homogeneous(best.R))), best.R, relaxation.multipliers)
    tries = [_proven(form, best), _certified(form, best, relaxation.multipliers), _certified(form, best, more)]
    y, certificate = max(tries, key=lambda pair: pair[1].lower_bound)
    return best, y, certificate


def _gradient(q: Array) -> Array:
    """(K, 9) of Q'x without its last entry."""
    rows: Array = q[:-1].reshape(-1, 9)
    return rows


def _proven(form: JointForm, end: Descent) -> tuple[Array, JointCertificate]:
    """By the multipliers at the answer, or by those of all constraints if they prove more."""
    reduced = form.reduced
    gradient = _gradient(reduced.apply(homogeneous(end.R)))
    multipliers = kkt_multipliers(end.R, gradient)
    first = _certified(form, end, multipliers)
    if first[1].is_optimal:
        return first
    second = _certified(form, end, improve(reduced.Q, end.R, multipliers)[0])
    return max([first, second], key=lambda pair: pair[1].lower_bound)


def _certified(form: JointForm, end: Descent, multipliers: Array) -> tuple[Array, JointCertificate]:
    """The answer and the bound that these multipliers (K, 20) prove."""
    K = form.sensors
    y = form.completed(homogeneous(end.R))
    wide = y.astype(np.longdouble)
    Qy = form.Q.astype(np.longdouble) @ wide
    cost = float(wide @ Qy)
    rounding = 4.0 * len(y) * float(np.finfo(np.longdouble).eps) * float(np.abs(y) @ np.abs(form.Q) @ np.abs(y))
    at = np.r_[np.arange(9 * K), len(y) - 1]
    Lambda = np.zeros_like(form.Q)
    Lambda[np.ix_(at, at)] = scatter(np.einsum("nk,kpq->npq", multipliers, CONSTRAINTS))
    gradient = (Qy - Lambda.astype(np.longdouble) @ wide)[:-1].astype(float)
    of_constraints = float(np.abs(multipliers * constraint_values(end.R)).sum())
    Z = (form.Q - Lambda)[:-1, :-1]
    Z = 0.5 * (Z + Z.T)
    loss, region, least = _loss(Z, gradient, K, y)
    # The rounding of Z itself, and of the gradient.
    lower = cost - rounding - of_constraints - loss
    tolerance = TOLERANCE * max(cost, 1.0)
    status = Status.CERTIFIED if cost - lower <= tolerance else Status.GAP
    return y, JointCertificate(status, cost, lower, least, tolerance, region)


def _loss(Z: Array, gradient: Array, K: int, y: Array) -> tuple[float, float, float]:
    """What is to be taken from the cost, the region of the bound, and the least eigenvalue of the scaled Z."""
    # A translation along which no window has any effect is in no term of the cost.
    matters = np.abs(Z).max(axis=1) > 0.0
    Z, gradient = Z[np.ix_(matters, matters)], gradient[matters]
    limit = np.r_[np.full(9 * K, 2.0), np.full(len(y) - 1 - 9 * K, REGION_M) + np.abs(y[9 * K : -1])][matters]
    n = len(Z)
    unit = 1.0 / np.sqrt(np.maximum(np.abs(np.diagonal(Z)), 1e-300))
    scaled = Z * unit[:, None] * unit
    # A Cholesky factorisation that succeeds proves the matrix positive semidefinite up to this (Rump 2006).
    hidden = 4.0 * n * (n + 1) * 2.0**-53
    g = gradient * unit
    values = np.linalg.eigvalsh(scaled)
    # First: positive definite, without any region.
    margin = 0.5 * float(values[0])
    if margin > hidden and _is_definite(scaled, margin + hidden):
        return float(g @ g) / margin, np.inf, margin
    # Else: not below -shift, and d limited.
    for shift in (hidden, 1e-11, 1e-9, 1e-7):
        if shift >= hidden and _is_definite(scaled, -shift):
            total = shift + hidden
            return 2.0 * float(np.abs(gradient) @ limit) + total * float(((limit / unit) ** 2).sum()), REGION_M, -total
    least = float(values[0]) - hidden
    rough = -min(least, 0.0) * float(((limit / unit) ** 2).sum())
    return 2.0 * float(np.abs(gradient) @ limit) + rough, REGION_M, least


def _is_definite(matrix: Array, less: float) -> bool:
    try:
        np.linalg.cholesky(matrix - less * np.eye(len(matrix)))
    except np.linalg.LinAlgError:
        return False
    return True


def star_starts(w: Array, s: Array, used: np.ndarray) -> list[Array]:
    """Starts (K, 3, 3) of the descents: each sensor aligned to sensor 0 by its turns and ways.

    ``w`` and ``s`` (m, n, 3) are the windows' rotation vectors and translations. Turns alone leave a rotation about one
    axis free where the vehicle turned about one only; the ways decide then, unless lever arms are long against them.
    """
    starts = []
    for of_ways in (0.0, 0.1, 1.0):
        rotations = []
        for k in range(1, len(w)):
            both = used[0] & used[k]
            a, b = w[0, both], w[k, both]
            c, d = (x / max(np.sqrt((x**2).mean()), 1e-300) for x in (s[0, both], s[k, both]))
            size = max(float(np.sqrt((a**2).mean())), 1e-300)
            M = (a / size).T @ (b / size) + of_ways * c.T @ d
            U, _, Vt = np.linalg.svd(M)
            rotations.append(U @ np.diag([1.0, 1.0, np.sign(np.linalg.det(U @ Vt))]) @ Vt)
        starts.append(np.array(rotations))
    return starts
