"""Errors that last as long as the view: a detector has no memory, so what lasts in its errors is of what it sees.

Lenses, boards and detectors err alike where the view is alike. A camera that moves slowly makes of this errors that
fade in time, and as such they are modelled (`drift`). But errors that fade in time average out in a long log, and those
of the view do not: a second pass over the same views errs as the first. So the errors' correlation is put on the
distance between views in place of the time between instants,

    cov(w_i, w_j) = a^2 exp(-|v_i - v_j| / l),    v = [t / |t|, R' t / |t|, log |t|] of T_sensor_target,

which is where the target is in the image, from where it is seen, and how far it is. Both models are fitted to the same
instants by restricted likelihood. With the probability that this leaves to errors of the view, the covariance is that
of the answer under them: with its weights K, K V K'.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.linalg import cho_solve, cholesky
from scipy.special import expit

from gtsam_rwhec.fitting.drift import own_directions, unit_of
from gtsam_rwhec.fitting.fit_options import C
from gtsam_rwhec.fitting.noise_likelihood import NoiseModel
from gtsam_rwhec.fitting.noise_search import Settled, Task
from gtsam_rwhec.fitting.unknowns import UnknownKind
from gtsam_rwhec.geometry.poses import Array

#: At most so many measurements are compared with each other, evenly over the log; with fewer, no view is told.
MOST, FEWEST = 80, 20
#: The likelihood is evaluated so often at most.
MOST_EVALUATIONS = 60
#: Deviation before the data of the logarithms of a size and of a length.
PRIOR = 2.0
#: Before the data, views are as far apart as their errors reach if they differ by this (rad, and a share of distance).
USUAL = 0.3


@dataclass(frozen=True)
class ViewErrors:
    """What errors of the view do to the covariance."""

    #: How much twice the log likelihood is larger than that of errors that fade in time
    evidence: float
    #: How much views differ where the correlation of their errors is 1 / e, rad
    reach_rad: float
    #: By how much variances are larger, for the frame for which it is most
    ratio: float


@dataclass(frozen=True)
class _Compared:
    """Some measurements of the model, as one dense system."""

    residual: Array  #: (6 n,)
    jacobian: Array  #: (6 n, p)
    base: Array  #: (6 n, 6 n): covariance without what lasts
    turning: Array  #: (6 n, 6 n): covariance of rotations that last, if all views were one
    moving: Array  #: (6 n, 6 n): of translations
    prior: Array  #: (p, p): What the problem's priors know

    def covariance(self, distance: Array, logs: Array) -> Array:
        """Of the residuals, for the logarithms of both sizes and of the length."""
        turning, moving, length = np.exp(np.clip(logs, -20.0, 20.0))
        near = np.exp(-distance / length).repeat(6, axis=0).repeat(6, axis=1)
        found: Array = self.base + (turning**2 * self.turning + moving**2 * self.moving) * near
        return found

    def weighed(self, covariance: Array) -> tuple[float, Array, Array]:
        """Minus twice the restricted log likelihood, the unknowns' covariance (p, p), and their weights (p, 6 n)."""
        factor = cholesky(covariance, lower=True)
        both = cho_solve((factor, True), np.column_stack([self.jacobian, self.residual]))
        information = self.jacobian.T @ both[:, :-1] + self.prior
        gradient = self.jacobian.T @ both[:, -1]
        known = np.linalg.inv(information)
        squares = float(self.residual @ both[:, -1] - gradient @ known @ gradient)
        logs = 2.0 * float(np.log(np.diagonal(factor)).sum()) + float(np.linalg.slogdet(information)[1])
        return logs + squares, known, known @ both[:, :-1].T

    def fitted(self, distance: Array, length: float) -> tuple[float, Array]:
        """The least of minus twice the log likelihood, with its prior, and the logarithms that make it."""
        from scipy.optimize import minimize  # here, since few logs need it

        start = np.array([0.0, 0.0, math.log(length)])

        def cost(logs: Array) -> float:
            return self.weighed(self.covariance(distance, logs))[0] + float((((logs - start) / PRIOR) ** 2).sum())

        simplex = start + np.vstack([np.zeros(3), np.eye(3)])
        found = minimize(
            cost, start, method="Nelder-Mead",
            options={"initial_simplex": simplex, "xatol": 0.05, "fatol": 0.1, "maxfev": MOST_EVALUATIONS},
        )  # fmt: skip
        return float(found.fun), found.x


def errors_of_view(task: Task, found: Settled) -> ViewErrors | None:
    """What errors of the view do where errors were found that fade in time; None elsewhere."""
    model, sigma = found.model, found.fit.sizes.values(found.fit.logs)
    if model.drift is None or model.drift.correlation == 1.0 or model.drift.walk.is_shared:
        return None
    frames = [
        model.basis[place]
        for unknown, place in task.layout.slots.items()
        if unknown.kind is UnknownKind.FRAME and not task.layout.free[place].any()
    ]
    compared, walked, views = _compared(model, sigma)
    if not frames or len(walked) < FEWEST:
        return None
    in_time, time_logs = compared.fitted(walked, -1.0 / math.log(model.drift.correlation))
    by_view, view_logs = compared.fitted(views, USUAL)
    _, known, weights = compared.weighed(compared.covariance(walked, time_logs))
    moved = weights @ compared.covariance(views, view_logs) @ weights.T
    ratios = [np.trace(np.linalg.solve(rows @ known @ rows.T, rows @ moved @ rows.T)) / 6.0 for rows in frames]
    evidence = in_time - by_view
    more = float(expit(0.5 * evidence)) * (max(ratios) - 1.0)
    return ViewErrors(evidence, math.exp(view_logs[2]), 1.0 + max(more, 0.0))


def _compared(model: NoiseModel, sigma: dict[C, float]) -> tuple[_Compared, Array, Array]:
    """Some of the measurements, the steps between them, and the distances (n, n) of their views."""
    assert model.drift is not None
    rows = model.rows.thinned(-(-len(model.rows.residual) // MOST))
    kept = np.isin(model.rows.instants.order, rows.instants.order)
    n, instants = len(rows.residual), rows.instants
    carrier = model.carrier(sigma)[kept]
    varying = np.repeat([sigma[C.SYSTEMATIC_ROTATION], sigma[C.SYSTEMATIC_TRANSLATION]], 3)
    effects = rows.twist[model.side] * varying
    base = np.einsum("nia,nk,mk,mja->nimj", effects, model.features[kept], model.features[kept], effects, optimize=True)
    base[np.arange(n), :, np.arange(n)] += model.white(sigma)[kept] + carrier @ carrier.transpose(0, 2, 1)
    states = (own_directions(rows, model.drift) * unit_of(sigma)).reshape(6 * n, -1)
    tracks = np.cumsum(instants.step == 0.0)[instants.index] * instants.chains + instants.chain
    apart = np.where(tracks[:, None] == tracks, 0.0, np.inf)
    walked = np.cumsum(instants.step)[instants.index]
    t = rows.predicted[:, :3, 3]
    far = np.linalg.norm(t, axis=1)
    seen = t / far[:, None]
    view = np.column_stack([seen, (seen[:, None] @ rows.predicted[:, :3, :3])[:, 0], np.log(far)])
    compared = _Compared(
        rows.residual.ravel(),
        rows.by_unknowns.by(model.basis).whole.reshape(6 * n, -1),
        base.reshape(6 * n, 6 * n),
        states[:, :3] @ states[:, :3].T,
        states[:, 3:] @ states[:, 3:].T,
        model.prior_information,
    )
    between = np.linalg.norm(view[:, None] - view, axis=2)
    return compared, np.abs(walked[:, None] - walked) + apart, between + apart
