"""The joint quadratic cost of all sensors' motions, which is certified (design fact 24).

With w_k the rotation vector and s_k the translation of sensor k over a window, and R_0 = I, t_0 = 0:

    R_k w_k                                     is the vehicle's rotation vector, for every sensor,
    R_k s_k + (I - V) t_k                       its translation, for every sensor of known scale,
    R_k s_k + (I - V) t'_k - alpha_k v = 0      for a sensor of unknown scale alpha_k, t' = alpha t.

The vehicle's rotation vector and translation are eliminated: residuals are the differences from the weighted mean, so
every pair of sensors counts and loops are consistent. V and v are the fused motion at the previous estimate, and are
fixed here. What is left is a quadratic form of y = [vec R_k, t_k, alpha_k, 1], with R_k the only constrained numbers.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from rwhec_factors.se3 import pose, so3_nearest

from gtsam_rwhec.errors import ScaleError
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.odometry.odometry_record import JointCertificate
from gtsam_rwhec.odometry.window_likelihood import State
from gtsam_rwhec.odometry.window_motions import WindowMotions
from gtsam_rwhec.solver.certificate import Status
from gtsam_rwhec.solver.descent import Descent, descend, homogeneous
from gtsam_rwhec.solver.reduced_form import ReducedForm, generalised_inverse_factor
from gtsam_rwhec.solver.relaxation import round_to_rotations, solve_by_blocks
from gtsam_rwhec.solver.rotations import CONSTRAINTS, constraint_values, kkt_multipliers, random_rotations
from gtsam_rwhec.solver.small_dual import improve, scatter, stationary_multipliers

I3 = np.eye(3)


@dataclass(frozen=True)
class JointForm:
    """x' Q x over y = [vec R_1, ..., vec R_K, t_1, ..., t_K, alpha of the scaled sensors, 1], the cost with its 1/2."""

    Q: Array  #: (d, d)
    sensors: int  #: K: all but sensor 0
    scaled: np.ndarray  #: (s,): which of the K have an unknown scale (0 is the first after sensor 0)

    @cached_property
    def _eliminated(self) -> tuple[Array, Array]:
        """The best translations and scales as a matrix times [vec R, 1], and the reduced form."""
        rotations, last = 9 * self.sensors, len(self.Q) - 1
        r, t = np.r_[np.arange(rotations), last], np.arange(rotations, last)
        factor, _ = generalised_inverse_factor(self.Q[np.ix_(t, t)])
        rows = factor.T @ self.Q[np.ix_(t, r)]
        reduced = self.Q[np.ix_(r, r)] - rows.T @ rows
        return -factor @ rows, 0.5 * (reduced + reduced.T)

    @property
    def reduced(self) -> ReducedForm:
        """The form of the rotations alone, for the search."""
        return ReducedForm.of_rotations(self._eliminated[1])

    def with_scales_near(self, scale: Array, share: float) -> JointForm:
        """The form with a prior row for each unknown scale in ``scale`` (K,), of relative standard deviation ``share``.

        A mirror image has a negative scale (design fact 5) and may cost less where the vehicle turned about one axis.
        """
        Q = self.Q.copy()
        for i, k in enumerate(self.scaled):
            row = np.zeros(len(Q))
            row[12 * self.sensors + i], row[-1] = 1.0 / (share * scale[k]), -1.0 / share
            Q += 0.5 * np.outer(row, row)
        return JointForm(Q, self.sensors, self.scaled)

    def completed(self, x: Array) -> Array:
        """y (d,) from x = [vec R, 1]: the best translations and scales."""
        y: Array = np.r_[x[:-1], self._eliminated[0] @ x, 1.0]
        return y

    def poses(self, y: Array) -> tuple[Array, Array]:
        """Poses (K, 4, 4) and scales (K,) of an answer; a scaled sensor's translation is divided by its scale."""
        K = self.sensors
        R = y[: 9 * K].reshape(K, 3, 3).transpose(0, 2, 1)
        scale = np.ones(K)
        scale[self.scaled] = y[12 * K : -1]
        T = pose(R, y[9 * K : 12 * K].reshape(K, 3) / scale[:, None])
        return T, scale


def joint_form(
    windows: WindowMotions, state: State, variances: Array, scaled: np.ndarray, prior_rows: Array | None = None
) -> JointForm:
    """The form with the windows' rotations and translations fixed to those of ``state.motion``.

    ``variances`` (m, 2) are of rotation (rad^2/s) and translation (m^2/s), ``scaled`` (m,) booleans, and ``prior_rows``
    (q, d) whitened rows over y, from the user's prior knowledge.
    """
    m, n = windows.used.shape
    K = m - 1
    which = np.flatnonzero(scaled[1:])
    d = 12 * K + len(which) + 1
    w, s, used = windows.rotation_vectors(), windows.M[..., :3, 3], windows.used
    V, v = state.motion[:, :3, :3], state.motion[:, :3, 3]
    of_rotation = used / (windows.length * variances[:, :1] + ~used)
    # Rotation noise also moves the window's end, by the distance from there: its mean square counts.
    turned = 2.0 / 3.0 * variances[:, :1] * np.einsum("mnii->mn", windows.second)
    of_translation = used / (windows.length * variances[:, 1:] + turned + ~used)

    E = np.zeros((m, n, 3, d))
    for k in range(m):
        if k:
            E[k, :, :, 9 * k - 9 : 9 * k] = _times(w[k])
        else:
            E[k, :, :, -1] = w[k]
    rows = [_contrasts(E, of_rotation)]

    E = np.zeros((m, n, 3, d))
    for k in range(m):
        if k:
            E[k, :, :, 9 * k - 9 : 9 * k] = _times(s[k])
            E[k, :, :, 9 * K + 3 * k - 3 : 9 * K + 3 * k] = I3 - V
        else:
            E[k, :, :, -1] = s[k]
    metric = ~scaled
    rows.append(_contrasts(E[metric], of_translation[metric]))
    # v comes from the sensors of known scale; it has the noise of their weighted mean.
    of_v = 1.0 / np.maximum(of_translation[metric].sum(axis=0), 1e-300)
    has_v = used[metric].any(axis=0)
    for i, k in enumerate((which + 1).tolist()):
        E[k, :, :, 12 * K + i] = -v
        weight = has_v / (1.0 / np.where(used[k], of_translation[k], 1.0) + state.scale[k] ** 2 * of_v) * used[k]
        rows.append((np.sqrt(weight)[:, None, None] * E[k]).reshape(-1, d))
    if prior_rows is not None and len(prior_rows):
        rows.append(prior_rows)
    Q = np.zeros((d, d))
    for part in rows:
        Q += 0.5 * part.T @ part
    return JointForm(0.5 * (Q + Q.T), K, which)


def _times(w: Array) -> Array:
    """The matrix (n, 3, 9) that gives R w when multiplied by vec R (columns stacked)."""
    matrix: Array = np.einsum("nj,ik->nijk", w, I3).reshape(len(w), 3, 9)
    return matrix


def _contrasts(E: Array, weight: Array) -> Array:
    """Whitened differences from the weighted mean over sensors: (m n 3, d) from (m, n, 3, d) and weights (m, n)."""
    total = weight.sum(axis=0)
    mean = np.einsum("mn,mnid->nid", weight, E) / np.where(total > 0.0, total, 1.0)[:, None, None]
    rows: Array = (np.sqrt(weight)[:, :, None, None] * (E - mean)).reshape(-1, E.shape[-1])
    return rows


#: The number of descents from random rotations, in addition to the given starts.
RANDOM_STARTS = 4
#: The most Newton steps of a descent.
MAX_DESCENT = 100
#: The relaxation is solved for at most so many sensors (beside the reference).
MAX_RELAXED = 60
#: For a mirror image: the relative standard deviation that holds the scales, and the rounds of it.
SCALE_SHARE, SCALE_ROUNDS = 0.1, 3
#: Positive scales may cost this many times as much as the mirror image.
MIRRORED_COST = 1.5
#: Where a proof needs a bounded region, translations are limited to this along each axis (m).
REGION_M = 1000.0
#: A smaller gap counts as zero; the cost is half a chi-square (design fact 10).
TOLERANCE = 1e-6


def solved(form: JointForm, starts: list[Array], *, axis: Array | None = None) -> tuple[Array, JointCertificate]:
    """The best y (d,) of descents from rotations (K, 3, 3), and the best bound found for it; it may not be unique.

    An answer with a negative scale is the mirror image of one with a positive scale (design fact 5), which costs about
    as much if the vehicle turned about one ``axis`` (3,). The sensor is then turned by half a turn
    about that axis; the answer is found and proven again with the scales held (``SCALE_SHARE``).

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
        return y, certificate
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
    return y, replace(with_positive, scales_held=True)


def _best(form: JointForm, starts: list[Array]) -> tuple[Descent, Array, JointCertificate]:
    """The best end of the descents, its y (d,), and the certificate with the highest bound."""
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
    """The entries of Q'x without the last one, (K, 9)."""
    return q[:-1].reshape(-1, 9)


def _proven(form: JointForm, end: Descent) -> tuple[Array, JointCertificate]:
    """Certified by the KKT multipliers of the answer, or by improved multipliers if their bound is higher."""
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
    """How far the bound is below the cost, the bound's region (m), and the least eigenvalue of the scaled Z."""
    # The cost does not contain a translation that affects no window.
    matters = np.abs(Z).max(axis=1) > 0.0
    Z, gradient = Z[np.ix_(matters, matters)], gradient[matters]
    limit = np.r_[np.full(9 * K, 2.0), np.full(len(y) - 1 - 9 * K, REGION_M) + np.abs(y[9 * K : -1])][matters]
    n = len(Z)
    unit = 1.0 / np.sqrt(np.maximum(np.abs(np.diagonal(Z)), 1e-300))
    scaled = Z * unit[:, None] * unit
    # If the Cholesky factorisation succeeds, no eigenvalue is below minus this (Rump 2006).
    hidden = 4.0 * n * (n + 1) * 2.0**-53
    g = gradient * unit
    values = np.linalg.eigvalsh(scaled)
    # First try: Z is positive definite; then no region is needed.
    margin = 0.5 * float(values[0])
    if margin > hidden and _is_definite(scaled, margin + hidden):
        return float(g @ g) / margin, np.inf, margin
    # Else: no eigenvalue is below -shift, and the answer's distance is limited.
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
    """Starts (K, 3, 3) of the descents: each sensor aligned to sensor 0 by its rotations and translations.

    ``w`` and ``s`` (m, n, 3) are the windows' rotation vectors and translations. If the
    vehicle turned about one axis only, rotations leave the angle about that axis free. Then translations determine it,
    unless the lever arms are long against them.
    """
    starts = []
    for of_ways in (0.0, 0.1, 1.0):
        rotations = []
        for k in range(1, len(w)):
            both = used[0] & used[k]
            a, b = w[0, both], w[k, both]
            c, d = (x / max(np.sqrt((x**2).mean()), 1e-300) for x in (s[0, both], s[k, both]))
            size = max(float(np.sqrt((a**2).mean())), 1e-300)
            rotations.append(so3_nearest((a / size).T @ (b / size) + of_ways * c.T @ d))
        starts.append(np.array(rotations))
    return starts
