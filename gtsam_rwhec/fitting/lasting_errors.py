"""Errors that last: those of the view, and those that fade too slowly in time to be seen as a drift.

A detector has no memory. Lenses, boards and detectors err alike where the view is alike. A camera that moves slowly
makes of this errors that fade in time, and as such they are modelled (`drift`). But errors that fade in time average
out in a long log, and those of the view do not: a second pass over the same views errs as the first. Between few poses,
both look white. So a share s of the errors is correlated by the distance between views or by the steps between
instants, in place of the model's own correlation,

    cov(e_i, e_j) = (1 - s) white [i = j] + s lasting exp(-|v_i - v_j| / l),  v = [t / |t|, R' t / |t|, log |t|]

of T_sensor_target: where the target is in the image, from where it is seen, and how far it is. Shares and reaches l on
a grid have the probability that their restricted likelihood gives them, with all sizes scaled alike to their best (the
nugget and the range of kriging; Cressie 1993, section 2.3). The covariance becomes that of the answer under the average
of all these: with the answer's weights K, K V K'.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.linalg import cho_solve, cholesky
from scipy.special import expit, logsumexp, softmax

from gtsam_rwhec.fitting.block_agreement import LARGELY
from gtsam_rwhec.fitting.drift import DriftPrior, own_directions, unit_of
from gtsam_rwhec.fitting.fit_options import SYSTEMATIC, C, Walk
from gtsam_rwhec.fitting.noise_likelihood import NoiseModel
from gtsam_rwhec.fitting.noise_rows import Rows
from gtsam_rwhec.fitting.noise_search import Settled, Task, of_every
from gtsam_rwhec.fitting.unknowns import UnknownKind
from gtsam_rwhec.geometry.poses import Array

#: At most so many measurements are compared with each other, evenly over the log. With fewer of a track, nothing is
#: told.
MOST, FEWEST = 80, 20
#: Frames that none of these sees have this share of the information of all.
HELD = 1e-6
#: The shares of the errors that last.
SHARES = (0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 0.97)
#: How far errors reach: where their correlation is 1 / e, of views (rad, and a share of distance), and of instants
#: where no drift is seen (a share of the log).
OF_VIEWS, OF_TIME = (0.1, 0.2, 0.4, 0.8), (0.1, 0.3, 1.0)
#: Before the data, the logarithm of how much more probable it is that some errors last than that none do.
LOG_ODDS = -math.log(3.0)
#: As detections err: rotations in the target's axes, translations along the sensor's.
OF_DETECTIONS = Walk(0.5, "detection")


@dataclass(frozen=True)
class LastingErrors:
    """What errors that last do to the covariance."""

    #: That there are some, beside what the model has
    probability: float
    #: By how much variances are larger, for the frame for which it is most
    ratio: float

    @property
    def is_by_far(self) -> bool:
        """Whether most of the covariance is theirs."""
        return self.ratio > LARGELY**2


@dataclass(frozen=True)
class _Compared:
    """Some measurements of the model, as one dense system."""

    residual: Array  #: (6 n,)
    jacobian: Array  #: (6 n, p)
    arm: Array  #: (6 n, 6 n): covariance of A's errors that vary with the configuration
    white: Array  #: (6 n, 6 n): of errors that are all white
    lasting: Array  #: (6 n, 6 n): of errors that all last, if all views were one
    prior: Array  #: (p, p): What the problem's priors know
    walked: Array  #: (n, n): steps from one instant to the other
    differ: Array  #: (n, n): how much views differ

    def of_lasting(self, near: Array) -> Array:
        """The covariance (6 n, 6 n) of errors that last, with correlations (n, n)."""
        return self.lasting * near.repeat(6, axis=0).repeat(6, axis=1)

    def weighed(self, share: float, near: Array) -> _Weighed:
        """How a share of the errors with correlations ``near`` (n, n) agrees with the residuals."""
        covariance = self.arm + (1.0 - share) * self.white + share * self.of_lasting(near)
        factor = cholesky(covariance, lower=True)
        both = cho_solve((factor, True), np.column_stack([self.jacobian, self.residual]))
        information = self.jacobian.T @ both[:, :-1] + self.prior
        gradient = self.jacobian.T @ both[:, -1]
        known = np.linalg.inv(information)
        freedom = len(self.residual) - len(known)
        scale = float(self.residual @ both[:, -1] - gradient @ known @ gradient) / freedom
        logs = 2.0 * float(np.log(np.diagonal(factor)).sum()) + float(np.linalg.slogdet(information)[1])
        return _Weighed(share, near, logs + freedom * math.log(scale), scale, known, known @ both[:, :-1].T)


@dataclass(frozen=True)
class _Weighed:
    share: float
    near: Array
    minus_two_log: float  #: Of the restricted likelihood, with all sizes scaled to their best
    scale: float  #: Of all variances
    known: Array  #: (p, p): covariance of the unknowns before that
    weights: Array  #: (p, 6 n): of the residuals in the answer


def lasting_errors(task: Task, found: Settled) -> LastingErrors | None:
    """What errors that last do; None where tracks are short, errors walk at random or are of A, or some poses slide."""
    model, sigma = found.model, found.fit.sizes.values(found.fit.logs)
    drift = model.drift
    is_other = drift is not None and (drift.correlation == 1.0 or drift.walk.is_shared)
    if is_other or model.rows.slides is not None:
        return None
    frames = [
        model.basis[place]
        for unknown, place in task.layout.slots.items()
        if unknown.kind is UnknownKind.FRAME and not task.layout.free[place].any()
    ]
    some = of_every(model, -(-len(model.rows.residual) // MOST), HELD)
    rows = some.rows
    if not frames or len(rows.residual) < FEWEST * len(np.unique(_tracks(rows))):
        return None
    compared, share = _compared(some, sigma)
    if drift is None:
        fading = np.eye(len(rows.residual))
        reaches = np.array(OF_TIME) * len(rows.residual)
    else:
        fading = np.exp(compared.walked * math.log(drift.correlation))
        reaches = np.zeros(0)
    answer = compared.weighed(share, fading)
    as_modelled = [answer] if drift is None else [compared.weighed(each, fading) for each in SHARES]
    near = [np.exp(-compared.differ / reach) for reach in OF_VIEWS] + [np.exp(-compared.walked / r) for r in reaches]
    lasting = [compared.weighed(each, alike) for alike in near for each in SHARES]
    logs, without = (np.array([-0.5 * one.minus_two_log for one in of]) for of in (lasting, as_modelled))
    evidence = float(logsumexp(logs) - logsumexp(without)) - math.log(len(lasting) / len(as_modelled))
    probability = float(expit(evidence + LOG_ODDS))
    # What the average of all these has more than the model: of errors that last, and of white ones. These average out
    # over all measurements, and not over those alone that are compared.
    scales = softmax(logs) * [one.scale / answer.scale for one in lasting]
    shares = np.array([one.share for one in lasting])
    alike = np.einsum("k,kij->ij", scales * shares, np.array([one.near for one in lasting]))
    more = compared.of_lasting(alike - share * fading)
    kept = 1.0 if drift is not None else len(rows.residual) / len(model.rows.residual)
    more += kept * (float(scales @ (1.0 - shares)) - (1.0 - share)) * compared.white
    known = answer.known if drift is not None else model.evaluate(sigma).covariance
    ratios = [1.0]
    for frame in frames:
        weights = frame @ answer.weights
        extra = np.linalg.solve(frame @ known @ frame.T, weights @ more @ weights.T)
        ratios.append(1.0 + probability * float(np.trace(extra)) / 6.0)
    return LastingErrors(probability, max(ratios))


def _tracks(rows: Rows) -> np.ndarray:
    """(n,): the track of each measurement."""
    instants = rows.instants
    found: np.ndarray = np.cumsum(instants.step == 0.0)[instants.index] * instants.chains + instants.chain
    return found


def _compared(model: NoiseModel, sigma: dict[C, float]) -> tuple[_Compared, float]:
    """Measurements as one dense system, and the share of their errors that last under the model."""
    rows = model.rows
    n, index = len(rows.residual), rows.instants.index
    varying = np.repeat([sigma.get(c, 0.0) for c in SYSTEMATIC], 3)
    effects = rows.twist[model.side] * varying
    arm = np.einsum("nia,nk,mk,mja->nimj", effects, model.features, model.features, effects, optimize=True)
    carrier = model.carrier(sigma)
    white = np.einsum("nia,nm,mja->nimj", carrier, index[:, None] == index, carrier, optimize=True)
    white[np.arange(n), :, np.arange(n)] += model.white(sigma)
    if model.drift is None:
        size = np.sqrt((rows.residual.reshape(n, 2, 3) ** 2).mean(axis=(0, 2))).repeat(3)
        states = own_directions(rows, DriftPrior.of(rows, OF_DETECTIONS))[:, :, :6] * size
    else:
        states = own_directions(rows, model.drift) * unit_of(sigma)
    own = states @ states.transpose(0, 2, 1)
    single = white[np.arange(n), :, np.arange(n)]
    share = 0.0
    if model.drift is not None:
        share = float(np.trace(np.linalg.solve(single + own, own), axis1=1, axis2=2).mean()) / 6.0
    states = states.reshape(6 * n, -1)
    lasting = states[:, :3] @ states[:, :3].T + states[:, 3:] @ states[:, 3:].T
    tracks = _tracks(rows)
    apart = np.where(tracks[:, None] == tracks, 0.0, np.inf)
    walked = np.cumsum(rows.instants.step)[index]
    t = rows.predicted[:, :3, 3]
    far = np.linalg.norm(t, axis=1)
    seen = t / far[:, None]
    view = np.column_stack([seen, (seen[:, None] @ rows.predicted[:, :3, :3])[:, 0], np.log(far)])
    compared = _Compared(
        rows.residual.ravel(),
        rows.by_unknowns.by(model.basis).whole.reshape(6 * n, -1),
        arm.reshape(6 * n, 6 * n),
        white.reshape(6 * n, 6 * n) / (1.0 - share),
        lasting / (share or 1.0),
        model.prior_information,
        np.abs(walked[:, None] - walked) + apart,
        np.linalg.norm(view[:, None] - view, axis=2) + apart,
    )
    return compared, share
