"""Frames that were at two poses: a target was moved, or a sensor's mount gave way.

Where nearly half of the measurements came after the move, the fit lies between both poses: the residuals in the moved
frame's own axes are two groups. A large step bends the answer itself, which looks like drift: so, where neighbours'
residuals are alike, each frame is given a second pose from some moment on. Where fewer than half came after it, they
are left out as outliers, and agree with one another in the axes of the frame that moved and in no others.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from rwhec_factors import se3
from scipy.spatial import cKDTree

from gtsam_rwhec.calibration.trial_fits import MEDIAN_OF_CHI, Sample, Spread, TrialFit, fitted
from gtsam_rwhec.fitting.noise_rows import stations
from gtsam_rwhec.fitting.refined import Refined, RefinedPoses
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.problem.knowledge import scale_at
from gtsam_rwhec.problem.measurements import Pair
from gtsam_rwhec.problem.problem import Problem

#: Two groups lie apart by this many times their own spread. (2,000 simulations each of white noise, random walks, walks
#: with noise, Student's t with 2 degrees of freedom and smooth errors, 20 to 160 measurements: 1 of 30,000 was.)
GROUPS_APART = 8.0
#: Neighbours among the carriers' poses are in the same group with this share, where the groups come with the poses.
SAME_GROUP = 0.9
#: Each group has at least this share of the measurements, and there are so many.
SMALLEST_GROUP, FEWEST_OF_GROUPS = 0.25, 20


@dataclass(frozen=True)
class TwoPoses:
    """A frame whose measurements fall into two groups; ``str()`` is a sentence's part."""

    frame: str
    #: How many measurements each group has
    first: int
    second: int
    #: How far apart the two poses of the frame are
    angle_rad: float
    distance_m: float
    #: The first measurement of the second group among those of its pair, counted from one, where the frame is in one
    #: pair and one group follows the other; else None
    from_row: int | None
    is_sensor: bool = False  #: Whether it is a sensor: then its mount gave way
    by_turns: bool = False  #: Whether the groups come by turns: no frame moves there and back so often

    def __str__(self) -> str:
        apart = f"{np.degrees(self.angle_rad):.2g} degrees and {1e3 * self.distance_m:.3g} mm apart"
        if self.by_turns:
            return (
                f"{self.frame} has measurements of two sensors, mixed: {self.first} agree on one pose and "
                f"{self.second} on another, {apart}, by turns: images of two cameras lie in one folder, or two "
                "sensors write to one topic"
            )
        when = "" if self.from_row is None else f" from measurement {self.from_row} on"
        moved = "its mount is loose or it was knocked" if self.is_sensor else "it was moved"
        return (
            f"{self.frame} was at two poses{when}: its measurements fall into groups of {self.first} and "
            f"{self.second}, {apart}, and each group agrees with itself ({moved}, or it was seen in two ways)"
        )


@dataclass(frozen=True)
class Measured:
    """All measurements of a pair in their order: A and B (N, 4, 4), and which are kept (N,)."""

    A: Array
    B: Array
    kept: np.ndarray


def measured_of(problem: Problem, inliers: Mapping[Pair, np.ndarray]) -> dict[Pair, Measured]:
    """The measurements of a problem, and which are kept: all without ``inliers``; empty without measurements."""
    raw = {pair: problem.measurements(*pair) for pair in problem.pairs} if problem.has_measurements else {}
    return {pair: Measured(of.A, of.B, inliers.get(pair, np.ones(len(of.A), dtype=bool))) for pair, of in raw.items()}


@dataclass(frozen=True)
class AtStations:
    """The kept measurements of one pair at each station of the carriers: an arm has one error at a station."""

    twists: tuple[Array, Array]  #: The mean residuals (S, 6), in the target's axes and in the sensor's
    A: Array  #: (S, 12)
    visits: np.ndarray
    rows: np.ndarray  #: The first measurement at each, among all of the pair


def residuals_at_stations(refined: Refined, measured: Mapping[Pair, Measured]) -> dict[Pair, AtStations]:
    """The residuals of an answer, by pair and station; without pairs of frames that it lacks."""
    found = {}
    for pair, one in measured.items():
        A = one.A[one.kept]
        twists = residual_twists(refined, pair, A, one.B[one.kept])
        if len(twists[0]):
            station = stations_of(A)
            first, visits = np.unique(station, return_index=True)[1], np.bincount(station)
            means = [np.stack([np.bincount(station, column) / visits for column in of.T], axis=1) for of in twists]
            rows = np.flatnonzero(one.kept)[first]
            found[pair] = AtStations((means[0], means[1]), A[first, :3].reshape(-1, 12), visits, rows)
    return found


def stations_of(A: Array) -> np.ndarray:
    """The station (N,) of each pose."""
    return stations(A[:, :3].reshape(-1, 12)) if len(A) else np.zeros(0, dtype=np.int64)


def two_poses(at: Mapping[Pair, AtStations]) -> TwoPoses | None:
    """The frame that was at two poses, the one whose groups of residuals are farthest apart; None where none was.

    A frame that moved also splits the residuals of the frames measured with it, so only one frame is named.
    """
    names = dict.fromkeys((name, side) for pair in at for side, name in enumerate(pair))
    found = [
        _groups(name, [(one, one.twists[side]) for pair, one in at.items() if pair[side] == name], is_sensor=side == 1)
        for name, side in names
    ]
    return max(found, key=lambda one: one[0], default=(0.0, None))[1]


def residual_twists(refined: RefinedPoses, pair: Pair, A: Array, B: Array) -> tuple[Array, Array]:
    """Residuals (N, 6) of some measurements, in the target's axes and in the sensor's; lengths are true ones."""
    X, Y = refined.X.get(pair.target), refined.Y.get(pair.sensor)
    if X is None or Y is None or not len(A):
        return np.zeros((0, 6)), np.zeros((0, 6))
    scale = scale_at(refined.scale, pair.target)
    measured = B.copy()
    measured[:, :3, 3] /= scale
    predicted = se3.inverse(Y.matrix()) @ A @ X.matrix()
    return se3.logmap(se3.inverse(measured) @ predicted), se3.logmap(measured @ se3.inverse(predicted))


def _groups(name: str, parts: list[tuple[AtStations, Array]], *, is_sensor: bool) -> tuple[float, TwoPoses | None]:
    """How far apart the best two groups of the residuals of a frame's pairs are, in their own spread, and the groups.

    None where they are not apart. Groups that come with the carriers' poses, and not one after the other in time, are
    an arm's error, or views of a board.
    """
    twists, visits = np.concatenate([of for _, of in parts]), np.concatenate([one.visits for one, _ in parts])
    n = len(twists)
    if n < FEWEST_OF_GROUPS:
        return 0.0, None
    away = twists - twists.mean(axis=0)
    size = np.repeat(np.sqrt((away.reshape(n, 2, 3) ** 2).mean(axis=(0, 2))), 3)
    if not (size > 0.0).all():
        return 0.0, None
    along = away / size @ np.linalg.svd(away / size, full_matrices=False)[2][0]
    order = np.argsort(along)
    ordered, k = along[order], np.arange(1, n)
    sums, squares = np.cumsum(ordered), np.cumsum(ordered**2)
    low, high = sums[:-1] / k, (sums[-1] - sums[:-1]) / (n - k)
    within = np.maximum(squares[-1] - k * low**2 - (n - k) * high**2, 1e-12) / (n - 2)
    apart = np.where(np.minimum(k, n - k) >= SMALLEST_GROUP * n, (high - low) / np.sqrt(within), 0.0)
    best = int(np.argmax(apart))
    if apart[best] <= GROUPS_APART:
        return 0.0, None
    is_high = np.zeros(n, dtype=bool)
    is_high[order[best + 1 :]] = True
    if is_high[0]:
        is_high = ~is_high  # the first group is that of the first measurement
    changes = np.flatnonzero(np.diff(is_high))
    if len(changes) > 1:
        nearest = cKDTree(np.concatenate([one.A for one, _ in parts]))
        neighbours = np.asarray(nearest.query(nearest.data, k=2)[1])[:, 1]
        if (is_high[neighbours] == is_high).mean() > SAME_GROUP:
            return 0.0, None
    step = twists[is_high].mean(axis=0) - twists[~is_high].mean(axis=0)
    groups = TwoPoses(
        frame=name,
        first=int(visits[~is_high].sum()),
        second=int(visits[is_high].sum()),
        angle_rad=float(np.linalg.norm(step[:3])),
        distance_m=float(np.linalg.norm(step[3:])),
        from_row=int(parts[0][0].rows[changes[0] + 1]) + 1 if len(changes) == 1 and len(parts) == 1 else None,
        is_sensor=is_sensor,
    )
    return float(apart[best]), groups


#: The step is tried at these shares of the rows, and then at each row between the neighbours of the best.
CUTS = tuple(np.arange(1, 8) / 8.0)
#: Each side of a cut has measurements from at least so many poses. Where there are more frames, the others hold a moved
#: one.
FEWEST_POSES, MOST_FRAMES = 6, 6
#: The product of the residuals' medians, rotation and translation, falls by this factor at least.
STEP_BETTER = 8.0
#: And by this factor at least below that of another explanation, where there is one.
CLEARLY_BETTER = 3.0
#: The two poses are this many standard deviations of one measurement apart, in rotation or in translation.
STEP_APART = 5.0
#: Rounds of a fit on trial, and halvings of the interval in which the step is looked for.
TRIAL_ROUNDS, HALVINGS = 2, 5


def step_of(problem: Problem, sample: Sample) -> tuple[TwoPoses, Spread] | None:
    """The frame that moved once, from some measurement of its pairs on, and the residuals that remain with two poses.

    None where none did.

    Parameters
    ----------
    problem : Problem
        For its scale and for what is known of frames.
    sample : dict of Pair to (A, B)
        Its measurements in their order, (N, 4, 4) each.
    """
    frames = {name for pair in sample for name in pair.frames}
    names = sorted(frames - set(problem.fixed))
    station = {pair: stations_of(A) for pair, (A, _) in sample.items()}
    number = sum(len(np.unique(of_pair)) for of_pair in station.values())
    if not names or len(frames) > MOST_FRAMES or number < 2 * FEWEST_POSES:
        return None
    plain = fitted(problem, sample, rounds=TRIAL_ROUNDS)
    if plain is None:
        return None

    def split(name: str, cut: float) -> TrialFit | None:
        """The fit with another name for a frame from a share of each of its pairs' rows on."""
        parts, poses = dict(sample), np.zeros(2, dtype=int)
        for pair, (A, B) in sample.items():
            if name in pair.frames:
                del parts[pair]
                row, then = round(cut * len(B)), Pair(*(_second(name) if of == name else of for of in pair))
                for side, (of, rows) in enumerate(((pair, slice(0, row)), (then, slice(row, None)))):
                    poses[side] += len(np.unique(station[pair][rows]))
                    if len(B[rows]):
                        parts[of] = (A[rows], B[rows])
        return fitted(problem, parts, rounds=TRIAL_ROUNDS) if poses.min() >= FEWEST_POSES else None

    def volume(name: str, cut: float) -> float:
        fit = split(name, cut)
        return np.inf if fit is None else _product(fit.residual)

    best, name, cut = min((volume(name, cut), name, cut) for name in names for cut in CUTS)
    if best * STEP_BETTER > _product(plain.residual):
        return None
    for halving in range(HALVINGS):
        away = 2.0 ** -(4 + halving)
        best, cut = min((best, cut), *((volume(name, at), at) for at in (cut - away, cut + away)))
    fit = split(name, cut)
    step = None if fit is None else _step(name, sample, cut, fit)
    return None if fit is None or step is None else (step, fit.residual)


def explains_more(problem: Problem, sample: Sample, remains: Spread) -> bool:
    """Whether a step of one frame leaves far smaller residuals than another explanation, which left `remains`.

    A step costs six unknowns and a moment; so what it leaves must be smaller by a factor, `CLEARLY_BETTER`.
    """
    found = step_of(problem, sample)
    return found is not None and _product(found[1]) * CLEARLY_BETTER < _product(remains)


def _second(name: str) -> str:
    return f"{name} after it moved"


def _product(residual: Spread) -> float:
    return residual.rotation_rad * residual.translation_m


def _step(name: str, sample: Sample, cut: float, fit: TrialFit) -> TwoPoses | None:
    """How far the frame moved, in standard deviations of its measurements; None where that is not far."""
    before, after = fit.frames[name], fit.frames[_second(name)]
    step = se3.logmap(se3.inverse(before[None]) @ after)[0]
    angle, distance = float(np.linalg.norm(step[:3])), float(np.linalg.norm(step[3:]))
    scale = abs(fit.one_scale)
    spread_rad, spread_m = fit.residual.rotation_rad / MEDIAN_OF_CHI, fit.residual.translation_m / MEDIAN_OF_CHI
    if angle < STEP_APART * spread_rad and distance * scale < STEP_APART * spread_m:
        return None
    rows = [(round(cut * len(B)), len(B)) for pair, (_, B) in sample.items() if name in pair.frames]
    first = sum(row for row, _ in rows)
    second = sum(count for _, count in rows) - first
    from_row = rows[0][0] + 1 if len(rows) == 1 else None
    return TwoPoses(name, first, second, angle, distance, from_row, any(name == pair.sensor for pair in sample))


#: At least this many of a frame's outliers, and this share of them, agree with one another.
FEWEST, MOST_OF_THEM = 4, 0.75
#: They lie this many times their own spread from the answer, in rotation or in translation.
OUTLIERS_APART = 8.0
#: Outliers agree within this many times the spread of the measurements that were kept.
NEAR = 6.0
#: The step of the frame that moved has a smaller spread (rotation times translation) than that of any other frame of
#: its pairs, by this factor: else it is open which of the two moved.
OUTLIERS_BETTER = 3.0
#: Smallest spreads: 0.003 degrees and 10 micrometres.
LEAST = np.array([5e-5, 1e-5])
#: A frame that moved does not move back: at most this share of the outliers (or of the inliers, if they are fewer) may
#: be on the wrong side of the moment. Outliers that come and go have another cause: another board was taken for this
#: one, or two sensors are mixed.
MISPLACED = 0.2


def moved_with_outliers(refined: Refined, measured: Mapping[Pair, Measured]) -> TwoPoses | None:
    """The frame that was elsewhere when the measurements that were left out were taken; None where none was.

    Parameters
    ----------
    refined : Refined
        The answer from those that were kept.
    measured : dict of Pair to Measured
        Without those that were removed for other reasons.
    """
    if all(one.kept.all() for one in measured.values()):
        return None
    twists = {pair: residual_twists(refined, pair, one.A, one.B) for pair, one in measured.items()}
    frames = dict.fromkeys(name for pair in measured for name in pair.frames)
    steps = []
    for name in frames:
        of_frame = [
            (of[pair.frames.index(name)], measured[pair].kept)
            for pair, of in twists.items()
            if name in pair.frames and len(of[0])
        ]
        if of_frame and (step := _step_with_outliers(name, of_frame, is_sensor=name in refined.Y)) is not None:
            steps.append(step)
    steps.sort(key=lambda step: step[0])
    if not steps or any(volume < OUTLIERS_BETTER * steps[0][0] for volume, _ in steps[1:]):
        return None
    found = steps[0][1]
    kept = [one.kept for pair, one in measured.items() if found.frame in pair.frames]
    if _come_and_go(kept):
        return None
    return replace(found, from_row=_moment(kept[0])[0] if len(kept) == 1 else None)


#: By chance the last measurements are those that are left out with this probability at most; and there are so many.
BY_CHANCE, FEWEST_LAST = 0.01, 3


def moved_at_the_end(refined: Refined, measured: Mapping[Pair, Measured]) -> TwoPoses | None:
    """The frame, or one of two, that is no longer where the answer has it: the last measurements agree on another pose.

    None where none is. Of n measurements k are left out, the last r of all among them; if each set of k is as likely,
    this has the probability (n - r choose k - r) / (n choose k). So a step counts that noise alone would not show. Not
    so in a stream, where neighbours are one view of a target, and not where another pair of the frame went on.
    """
    ended = {name for pair in measured for name in pair.frames}
    ended -= {name for pair, one in measured.items() if one.kept[-1:].any() for name in pair.frames}
    for pair, one in measured.items():
        n, k = len(one.kept), int((~one.kept).sum())
        last = np.arange(n) > np.flatnonzero(one.kept).max(initial=-1)
        r, twists = int(last.sum()), residual_twists(refined, pair, one.A, one.B)
        is_chance = len(measured) * math.comb(n - r, k - r) > BY_CHANCE * math.comb(n, k)
        if not FEWEST_LAST <= r < n or is_chance or not len(twists[0]):
            continue
        nearest = cKDTree(one.A[:, :3].reshape(n, -1))
        if last[np.asarray(nearest.query(nearest.data[last], k=2)[1])[:, 1]].mean() > 0.5:
            continue
        steps = []
        for name, of in zip(pair.frames, twists, strict=True):
            middle, near = np.median(of[last], axis=0), np.median(_sizes(of[one.kept]), axis=0)
            off = _sizes(of[last] - middle)
            if name in ended and (off <= NEAR * np.maximum(near, LEAST)).all(axis=1).mean() >= MOST_OF_THEM:
                steps.append((np.maximum(np.median(off, axis=0), LEAST).prod(), name, *_sizes(middle[None])[0]))
        steps.sort()
        if steps:
            _, name, angle, distance = steps[0]
            is_open = any(spread < OUTLIERS_BETTER * steps[0][0] for spread, *_ in steps[1:])
            who = " or ".join(pair.frames) if is_open else name
            return TwoPoses(who, n - k, r, angle, distance, n - r + 1, not is_open and name == pair.sensor)
    return None


#: By chance neighbours are so much alike with this probability at most, as of so many draws. Among more measurements
#: than these, outliers come in bursts, and those that were kept tell of drift.
ALIKE_BY_CHANCE, DRAWS, MOST_ALIKE = 1e-3, 5000, 39


def outliers_drift(refined: Refined, measured: Mapping[Pair, Measured]) -> bool:
    """Whether outliers are off as their neighbours are, in the axes of targets or of sensors: they drift or moved.

    The test is von Neumann's. The sum of the squared steps from each measurement's residual to the next is compared
    with those in other orders and with other signs, which are as likely if wrong measurements have nothing to do with
    one another. Not so in a stream, where neighbours are one view of a target.
    """
    chance = np.random.default_rng(0)
    sums = np.zeros((2, DRAWS + 1))  # of each side: as measured, and as drawn
    for pair, one in measured.items():
        n, both = len(one.kept), residual_twists(refined, pair, one.A, one.B)
        if n > MOST_ALIKE or one.kept.all() or not one.kept.any() or not len(both[0]):
            continue
        poses = one.A[:, :3].reshape(n, -1)
        nearest = np.asarray(cKDTree(poses).query(poses, k=2)[1])[:, 1]
        if (np.abs(nearest - np.arange(n)) == 1).mean() > 0.5:
            continue
        order = np.vstack([np.arange(n), chance.permuted(np.tile(np.arange(n), (DRAWS, 1)), axis=1)])
        signs = np.vstack([np.ones((1, n, 2)), chance.choice([-1.0, 1.0], (DRAWS, n, 2))])[..., None]
        for side, of in enumerate(both):
            near = np.maximum(np.median(_sizes(of[one.kept]), axis=0), LEAST)
            parts = of.reshape(n, 2, 3) / near[:, None]
            sums[side] += (np.diff(signs * parts[order], axis=1) ** 2).sum(axis=(1, 2, 3))
    return bool(((sums[:, 1:] <= sums[:, :1]).mean(axis=1) < ALIKE_BY_CHANCE).any())


#: So many outliers of two mixed sensors agree on the second, and this share of all: boards' turns may be wrong. Where
#: the second camera's lens is another one, they agree within a share of their angle and distance only, but most do.
FEWEST_MIXED = 3
MIXED_SHARES = ((0.25, 0.0), (0.5, 0.15))
#: Each of so many outliers, evenly over the rows, is tried as the one that the others agree with.
ANCHORS = 50


def mixed_sensors(refined: Refined, measured: Mapping[Pair, Measured]) -> TwoPoses | None:
    """The sensor among whose measurements are some of another: outliers, by turns, that agree on one other pose of it.

    None where none is. The outliers do not agree in their targets' axes as well: those would be one view, seen twice.
    """
    for sensor in dict.fromkeys(pair.sensor for pair in measured):
        rows = [(of, residual_twists(refined, of, one.A, one.B), one.kept) for of, one in measured.items()]
        rows = [(pair, twists, kept) for pair, twists, kept in rows if pair.sensor == sensor and len(twists[0])]
        if not rows:
            continue
        of_sensor, kept = np.concatenate([both[1] for _, both, _ in rows]), np.concatenate([one for *_, one in rows])
        of_target = np.concatenate([both[0] for _, both, _ in rows])
        away, near = of_sensor[~kept], NEAR * np.maximum(np.median(_sizes(of_sensor[kept]), axis=0), LEAST)
        masks = [one for *_, one in rows]
        if len(away) < FEWEST_MIXED or not _come_and_go(masks):
            continue
        anchors = away[:: -(-len(away) // ANCHORS)]
        for share, loose in MIXED_SHARES:
            alike = ((_sizes(away - one) <= np.maximum(near, loose * _sizes(one[None]))).all(axis=1) for one in anchors)
            agree = max(alike, key=np.count_nonzero)
            if agree.sum() >= max(FEWEST_MIXED, share * len(away)):
                break
        else:
            continue
        middle, of_target = np.median(away[agree], axis=0), of_target[~kept][agree]
        spreads = [
            np.maximum(np.median(_sizes(of - np.median(of, axis=0)), axis=0), LEAST).prod()
            for of in (away[agree], of_target)
        ]
        angle, distance = size = _sizes(middle[None])[0]
        # no two mounts are parallel to within the noise: lengths alone are off where a reading is wrong
        if spreads[0] * OUTLIERS_BETTER < spreads[1] and (size > OUTLIERS_APART * near / NEAR).all():
            return TwoPoses(sensor, int(kept.sum()), int(agree.sum()), float(angle), float(distance), None, True, True)
    return None


def _step_with_outliers(
    name: str, of_frame: list[tuple[Array, np.ndarray]], *, is_sensor: bool
) -> tuple[float, TwoPoses] | None:
    """The step that the outliers of a frame agree on, after the product of their spreads about it in both parts.

    ``of_frame`` has the residuals (N, 6) of its pairs, and which are kept. None where outliers disagree, or are few.
    """
    kept, away = (np.concatenate([twists[of == is_kept] for twists, of in of_frame]) for is_kept in (True, False))
    if len(away) < FEWEST:
        return None
    of_kept = np.maximum(np.median(_sizes(kept), axis=0), LEAST)
    middle = np.median(away, axis=0)
    for _ in range(3):  # the median of those that agree
        off = _sizes(away - middle)
        agree = (off <= np.maximum(NEAR * of_kept, 2.0 * np.median(off, axis=0))).all(axis=1)
        if agree.sum() < FEWEST:
            return None
        middle = np.median(away[agree], axis=0)
    spread = np.maximum(np.median(_sizes(away[agree] - middle), axis=0), LEAST)
    angle, distance = size = _sizes(middle[None])[0]
    if agree.sum() < MOST_OF_THEM * len(away) or (size < OUTLIERS_APART * spread).all():
        return None
    found = TwoPoses(name, len(kept), int(agree.sum()), float(angle), float(distance), None, is_sensor)
    return float(spread.prod()), found


def _sizes(twists: Array) -> Array:
    """Angles and distances (N, 2) of twists (N, 6)."""
    return np.asarray(np.linalg.norm(twists.reshape(-1, 2, 3), axis=2))


def _come_and_go(kept: list[np.ndarray]) -> bool:
    """Whether measurements that are left out, of some pairs, are not all before or after one moment."""
    fewer = sum(min(int(of.sum()), int((~of).sum())) for of in kept)
    return sum(_moment(of)[1] for of in kept) > MISPLACED * fewer


def _moment(kept: np.ndarray) -> tuple[int | None, int]:
    """The row, counted from one, where most measurements change from kept to left out, or the reverse.

    Also the number on the wrong side of this row. There is no such row where all are kept, or all left out.
    """
    number = len(kept)
    if kept.all() or not kept.any():
        return None, 0
    rows = np.arange(1, number)
    before = np.cumsum(kept)[:-1]  # kept among the first `row` rows
    wrong = np.minimum((rows - before) + (kept.sum() - before), before + (number - rows) - (kept.sum() - before))
    best = int(np.argmin(wrong))
    return int(rows[best]) + 1, int(wrong[best])
