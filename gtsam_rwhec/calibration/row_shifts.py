"""Shifts between the rows of A and B of one pair: the cost of each row at each shift, and the shifts that cost least.

Many parts of the rows are fitted in closed form, at each shift: a part in which all rows have one shift gives X and Y,
and these tell the shifts of all other rows. `between_rows` asks whether A lies a part of a step beside its row: a
robot logs its pose before its move has ended, or a clock is late where there are no stamps.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from rwhec_factors.se3 import adjoint, inverse, logmap
from scipy.special import chdtrc, expit

from gtsam_rwhec.calibration.moved_frames import LEAST, Measured
from gtsam_rwhec.calibration.trial_fits import MEDIAN_OF_CHI, Spread, angles
from gtsam_rwhec.files.terminal_text import rounded
from gtsam_rwhec.fitting.refined import Refined
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.problem.knowledge import scale_at
from gtsam_rwhec.problem.measurements import Pair
from gtsam_rwhec.solver.sample_poses import poses_of_samples

#: B's row i may belong to the rows of A from i - 3 to i + 3.
SHIFTS = np.arange(-3, 4)
AS_GIVEN = int(np.flatnonzero(SHIFTS == 0)[0])
#: No sensor is better than this (rad, and as a share of the variation of B).
SMALLEST = 2e-4
#: Degrees of freedom of Student's t.
DEGREES_OF_T = 6.0
#: A row whose A would be before the first row or after the last one costs as much more (nats) than at its best shift.
UNSAID = 1.0
#: Parts of this share of all rows are fitted, and of so many rows at least; each begins half of its length later.
SHARES, FEWEST_OF_A_PART = (1.0, 0.5, 0.25, 0.125), 5
#: Parts have at most so many rows, from all over them.
MOST_OF_A_PART = 60


def errors_at_shifts(A: Array, B: Array, rows: np.ndarray, Y: Array, X: Array, scale: Array | float) -> Array:
    """Angles (rad) and distances (..., 2, S, n) of B's rows from their predictions at each shift.

    Y and X (..., 4, 4) are poses of the sensor and of the target, A and B (N, 4, 4) all measurements of the pair.
    Infinite where a row has no A at that shift.
    """
    predicted = inverse(Y)[..., None, :, :] @ A @ X[..., None, :, :]
    scale = np.asarray(scale)[..., None, None]
    found = np.full((*Y.shape[:-2], 2, len(SHIFTS), len(rows)), np.inf)
    for k, shift in enumerate(SHIFTS):
        there = (rows + shift >= 0) & (rows + shift < len(A))
        T, S = predicted[..., rows[there] + shift, :, :], B[rows[there]]
        found[..., 0, k, there] = angles(S[:, :3, :3], T[..., :3, :3])
        away = np.linalg.norm(S[:, :3, 3] - scale * T[..., :3, 3], axis=-1)
        found[..., 1, k, there] = away
    return found


def costs_of(errors: Array, spread: Array, signal: Spread) -> Array:
    """The cost (..., S, n) of each row at each shift: minus its log likelihood, and at most that of a wrong row.

    ``spread`` (..., 2) has the median errors of right rows; ``signal`` what B varies by. Right rows have Student's t
    noise, wrong ones are anywhere in the variation of B.
    """
    least = [SMALLEST, max(SMALLEST * signal.translation_m, 1e-12)]
    s = np.maximum(spread, least) / MEDIAN_OF_CHI
    S = np.maximum(np.array([signal.rotation_rad, signal.translation_m]) / MEDIAN_OF_CHI, s)
    squared = ((errors / s[..., None, None]) ** 2).sum(axis=-3)
    tail = 0.5 * (DEGREES_OF_T + 6.0)
    right = 3.0 * np.log(s.prod(axis=-1))[..., None, None] + tail * np.log1p(squared / DEGREES_OF_T)
    wrong = 3.0 * np.log(S.prod(axis=-1))[..., None, None] + tail * math.log1p(6.0 / DEGREES_OF_T)
    costs = np.minimum(right, wrong)
    # a row whose A is not there speaks for no shift
    return np.asarray(np.where(np.isinf(errors[..., 0, :, :]), costs.min(axis=-2, keepdims=True) + UNSAID, costs))


def cheapest(costs: Array, price: float) -> tuple[np.ndarray, Array]:
    """Each row's shift with the least sum of costs (..., S, n) and of prices of changes (Viterbi), and this sum.

    The shifts (..., n) are numbers into `SHIFTS`. Rows that are not as given from the first on are a change too. The
    time is linear in the rows.
    """
    number, n = costs.shape[-2:]
    total = costs[..., 0] + np.where(np.arange(number) == AS_GIVEN, 0.0, price)
    came, own = np.empty((n, *total.shape), dtype=np.int8), np.arange(number)
    for i in range(1, n):
        jump = total.min(axis=-1, keepdims=True) + price
        came[i] = np.where(total <= jump, own, total.argmin(axis=-1)[..., None])
        total = np.minimum(total, jump) + costs[..., i]
    states = np.empty((*total.shape[:-1], n), dtype=np.int64)
    states[..., -1] = total.argmin(axis=-1)
    for i in range(n - 1, 0, -1):
        states[..., i - 1] = np.take_along_axis(came[i], states[..., i, None], axis=-1)[..., 0]
    return states, total.min(axis=-1)


def likely_shifts(
    A: Array, B: Array, rows: np.ndarray, signal: Spread, price: float, most: int, *, is_scaled: bool
) -> list[np.ndarray]:
    """The shifts (n,) of a pair's rows, as numbers into `SHIFTS`, that cost least under fits of parts of the rows.

    ``is_scaled``: lengths in B are true lengths times a factor. At most ``most`` are returned, the best first.
    """
    n = len(rows)
    found: dict[bytes, tuple[float, np.ndarray]] = {}
    for length in sorted({max(round(share * n), FEWEST_OF_A_PART) for share in SHARES}):
        if length > n:
            continue
        begins = np.unique(np.append(np.arange(0, n - length + 1, max(length // 2, 1)), n - length))
        inside = np.unique(np.linspace(0, length - 1, min(length, MOST_OF_A_PART)).astype(int))
        parts = rows[begins[:, None] + inside]
        # every part at every shift, where more than half of it has an A
        own = parts[:, None] + SHIFTS[:, None]
        there = (own >= 0) & (own < len(A))
        part, shift = np.nonzero(there.sum(axis=-1) >= min(FEWEST_OF_A_PART, length))
        of_A, of_B, weight = np.clip(own[part, shift], 0, len(A) - 1), parts[part], there[part, shift].astype(float)
        Y, X, scale, spread = fits_of_parts(A[of_A], B[of_B], weight, is_scaled=is_scaled)
        costs = costs_of(errors_at_shifts(A, B, rows, Y, X, scale), spread, signal)
        for states, total in zip(*cheapest(costs, price), strict=True):
            key = states.tobytes()
            if key not in found or total < found[key][0]:
                found[key] = (float(total), states)
    return [states for _, states in sorted(found.values(), key=lambda one: one[0])[:most]]


def fits_of_parts(A: Array, B: Array, weight: Array, *, is_scaled: bool) -> tuple[Array, Array, Array, Array]:
    """Y and X (W, 4, 4), the scales (W,) and the median errors (W, 2) of W parts A, B (W, w, 4, 4); weights (W, w)."""
    X, Y, scale = poses_of_samples(A, B, weight, is_scaled=is_scaled)
    predicted = inverse(Y)[:, None] @ A @ X[:, None]
    away = np.linalg.norm(B[..., :3, 3] - scale[:, None, None] * predicted[..., :3, 3], axis=-1)
    errors = np.stack([angles(B[..., :3, :3], predicted[..., :3, :3]), away], axis=1)
    # of the 6 w equations, 12 or 13 were spent
    w = weight.shape[1]
    spent = math.sqrt(6 * w / max(6 * w - 12 - is_scaled, 1))
    return Y, X, scale, spent * np.median(errors, axis=-1)


#: Pairs of fewer rows are not tested; of more than the second, some all over them are.
FEWEST_BETWEEN, MOST_BETWEEN = 6, 2000
#: Rounds in which the weights of rotation and translation settle.
ROUNDS = 6
#: Beforehand, the logarithm of how much more probable it is that A lies between rows than not, and by which share then.
LATE_LOG_ODDS, USUAL_SHARE = -math.log(10.0), 0.1


@dataclass(frozen=True)
class BetweenRows:
    """Poses A that lie between those of two rows; ``str()`` is one sentence."""

    pair: Pair
    #: How far on the way to the pose before; or, for a late clock, how many rows later than B (less than 0: earlier)
    share: float
    is_late: bool
    sigmas: float  #: The share in its standard deviations
    moved: dict[str, Array]  #: frame: (6, 1), how it moves where the share counts
    chance: float = 1.0  #: of so many deviations in any pair, where A lies at its rows

    @property
    def moves(self) -> dict[str, Array]:
        """The same by the probability that A lies there (Bayes): the root mean square, as one error."""
        squared, ratio = self.sigmas**2, (USUAL_SHARE * self.sigmas / self.share) ** 2 if self.share else 0.0
        shrunk = ratio / (1.0 + ratio)
        is_there = expit(LATE_LOG_ODDS - 0.5 * math.log1p(ratio) + 0.5 * squared * shrunk)
        of_share = math.sqrt(is_there * (shrunk**2 + shrunk / squared)) if squared else 0.0
        return {name: of_share * move for name, move in self.moved.items()}

    def __str__(self) -> str:
        where = f"{100.0 * abs(self.share):.2g} % of "
        if self.is_late:
            where += f"a row {'later' if self.share > 0.0 else 'earlier'} than its B: a clock is off, in motion"
        else:
            where += f"the way {'to' if self.share > 0.0 else 'away from'} the pose before it: it was logged too early"
        return f"each A of {self.pair} is {where} ({rounded(self.sigmas)} standard deviations)"


def between_rows(refined: Refined, measured: Mapping[Pair, Measured]) -> BetweenRows | None:
    """The pair whose poses A most likely lie between those of rows, as one share of a step.

    With A Exp(s step), residuals e are linear in s and in what moves both frames. None also where clocks are estimated.
    """
    found = []
    for pair, one in measured.items():
        rows = np.flatnonzero(one.kept)
        rows = rows[:: 1 + len(rows) // MOST_BETWEEN]
        is_known = pair.target in refined.X and pair.sensor in refined.Y
        if not is_known or pair.sensor in refined.time_offsets_s or len(rows) < FEWEST_BETWEEN:
            continue
        X, Y = refined.X[pair.target].matrix(), refined.Y[pair.sensor].matrix()
        predicted, B = inverse(Y) @ one.A[rows] @ X, one.B[rows].copy()
        B[:, :3, 3] /= scale_at(refined.scale, pair.target)
        e = logmap(inverse(B) @ predicted)
        still = np.concatenate([np.tile(np.eye(6), (len(e), 1, 1)), -adjoint(inverse(predicted))], axis=2)
        back, on = np.zeros((2, len(one.A), 6))
        back[1:], on[:-1] = logmap(inverse(one.A[1:]) @ one.A[:-1]), logmap(inverse(one.A[:-1]) @ one.A[1:])
        for step, is_late in ((back, False), (0.5 * (on - back), True)):
            along = -adjoint(inverse(X[None])) @ step[rows, :, None]  # A as it is, less so much of the step
            less, x, _ = _fitted(still, e)
            more, there, r = _fitted(np.concatenate([still, along], axis=2), e)
            of_X, of_Y = (there[:12] - x).reshape(2, 6, 1)
            # Neighbours that are alike count as fewer.
            alike = np.clip((r[1:] * r[:-1]).sum() / max(float((r**2).sum()), 1e-300), 0.0, 0.99)
            evidence = (6 * len(e) - 13) * (less - more) * (1.0 - alike) / (1.0 + alike)
            s, sigmas = float(there[12]), float(np.sqrt(max(evidence, 0.0)))
            found.append(BetweenRows(pair, s, is_late, sigmas, {pair.target: of_X, pair.sensor: of_Y}))
    best = max(found, key=lambda one: one.sigmas, default=None)
    return None if best is None else replace(best, chance=len(found) * float(chdtrc(1.0, best.sigmas**2)))


def _fitted(J: Array, e: Array) -> tuple[float, Array, Array]:
    """The logarithms of both spreads of e + J x at their best, its unknowns x, and what is left in deviations."""
    w: Array = np.ones(6)
    x: Array = np.zeros(J.shape[2])
    r, spreads = e, w[:2]
    for _ in range(ROUNDS):
        x = np.linalg.lstsq((w[:, None] * J).reshape(e.size, -1), -(w * e).reshape(-1), rcond=None)[0]
        r = e + J @ x
        spreads = np.maximum(np.sqrt((r.reshape(-1, 2, 3) ** 2).mean(axis=(0, 2))), LEAST)
        w = 1.0 / np.repeat(spreads, 3)
    return float(np.log(spreads).sum()), x, w * r
