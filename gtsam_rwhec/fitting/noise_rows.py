"""All measurements of a problem as rows of one linear model, with the directions in which each kind of noise acts.

About an estimate the residual r = Log(B^-1 S(Y^-1 A X)) of a measurement is

    r + J d = noise of B + E e + G w + sum_k f_k E u_k

d moves the unknowns; e is a twist of A at this instant, on the side of what moves; w is the drift of the sensor's
track; u_k are the arm's systematic errors, which vary smoothly with its configuration (f_k).
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import Any

import gtsam
import numpy as np
from rwhec_factors import se3
from rwhec_factors.batch import Linearization

from gtsam_rwhec.fitting.clock_rates import RATE
from gtsam_rwhec.fitting.fit_options import About
from gtsam_rwhec.fitting.joint_covariance import JointCovariance
from gtsam_rwhec.fitting.pair_data import PairData
from gtsam_rwhec.fitting.pose_fit import linearized
from gtsam_rwhec.fitting.pose_graph import add_priors, normal_equations_of
from gtsam_rwhec.fitting.unknowns import State, Unknown, UnknownKind, Variables, slots_of
from gtsam_rwhec.fitting.variance_components import jacobian_of
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.problem.problem import Problem

#: The lengths by which configurations are compared (an assumption about arms): rad, and m.
SMOOTH_RAD, SMOOTH_M = 1.5, 0.75
#: Directions of the configurations with less than this share of their spread are left out.
SMALLEST_SPREAD = 1e-4
#: A carrier stands still while no entry of its pose (1, m) changes by more than this.
STILL = 5e-5
#: Poses of an arm that comes back to a station are so near to their mean (1, and lengths by the motion's spread over
#: ``SPREAD_M``): the first of these that fits. Those of other stations are ``APART`` times as far at least.
REVISITED, APART, SPREAD_M = (1e-3, 6e-3), 10.0, 0.3
#: More pairs of near poses than this, an instant, are not those of visits to stations.
MOST_LINKS = 50
#: Stations are sought if this share of so many sampled poses has another pose near; with stations, half have.
FEWEST_REVISITED, SAMPLED = 0.2, 300
#: A velocity is taken from neighbours that are no further apart than this, s.
NEIGHBOURS_S = 0.5
#: Variances along the axes that differ by less than this share are one.
ALIKE = 1e-3


@dataclass(frozen=True)
class Instants:
    """Measurements grouped by instant: one carrier pose each, or one standstill, in order of time within a track."""

    #: (N,): The measurements' places in the order of the pairs' data.
    order: np.ndarray
    #: (T,): The first measurement of each instant, in that order.
    first: np.ndarray
    #: (N,): The instant of each measurement, in that order.
    index: np.ndarray
    #: (N,): The place of each measurement's track in the state of its instant.
    chain: np.ndarray
    #: The number of tracks in one state.
    chains: int
    #: (T,): Time since the instant before, in typical steps; 0 where a track begins.
    step: Array
    #: (T,): Time since the first instant.
    seconds: Array | None

    @property
    def count(self) -> int:
        """The number of instants."""
        return len(self.first)

    @property
    def bodies(self) -> np.ndarray:
        """(chains,): The body that each track is of: tracks that share instants are of one."""
        body = np.arange(self.chains)
        for _ in range(self.chains):
            least = np.full(self.count, self.chains)
            np.minimum.at(least, self.index, body[self.chain])
            new = body.copy()
            np.minimum.at(new, self.chain, least[self.index])
            if np.array_equal(new, body):
                break
            body = new
        return np.unique(body, return_inverse=True)[1]

    def cut(self, jumps: np.ndarray) -> Instants:
        """The same, with as good as nothing known of a drift across some instants (J,)."""
        step = self.step.copy()
        step[jumps] = np.maximum(step[jumps], ACROSS)
        return replace(self, step=step)

    @staticmethod
    def of(data: list[PairData]) -> Instants:
        """An instant has the measurements of one A (and stamp, where there are any), standstill or station."""
        pair = np.concatenate([np.full(item.count, i) for i, item in enumerate(data)])
        has_stamps = all(item.stamps_ns is not None for item in data)
        within = np.concatenate([np.arange(item.count) for item in data])
        stamps = np.concatenate([item.stamps_ns for item in data]) if has_stamps else within
        A = np.concatenate([item.residuals.A for item in data])
        rounded = np.round(A[:, :3].reshape(len(A), 12), 9)
        keys = np.column_stack([(stamps - stamps.min()).astype(np.float64) * has_stamps, rounded])
        first_of, same = np.unique(keys, axis=0, return_index=True, return_inverse=True)[1:]
        same = same.ravel()
        poses = A[first_of, :3].reshape(-1, 12)
        if has_stamps or len(data) == 1:  # the rows of one pair are in order of time
            still = standstills(poses, stamps[first_of])
            poses, same = poses[np.unique(still, return_index=True)[1]], still[same]
        same = stations(poses)[same]
        if len(np.unique(same)) == len(same):  # no instant is shared: one track after the other
            order = np.lexsort((stamps, pair))
            begins = np.r_[True, np.diff(pair[order]) != 0]
            index, chain, chains = np.arange(len(order)), np.zeros(len(order), dtype=np.int64), 1
        else:
            earliest = np.full(same.max() + 1, np.iinfo(np.int64).max)
            np.minimum.at(earliest, same, stamps)
            order = np.lexsort((pair, same, earliest[same]))
            changes = np.r_[True, np.diff(same[order]) != 0]
            index, chain, chains = np.cumsum(changes) - 1, pair[order], len(data)
            begins = np.arange(index[-1] + 1) == 0
        first = np.flatnonzero(np.r_[True, np.diff(index) != 0])
        seconds = (stamps[order][first] - stamps.min()) * 1e-9 if has_stamps else None
        step = np.ones(len(first))
        if seconds is not None:
            step[1:] = np.diff(seconds)
            usual = step[1:][(step[1:] > 0.0) & ~begins[1:]]
            step = step / np.median(usual) if len(usual) else np.ones(len(first))
            step = np.clip(step, 1e-3, 1e3)
        return Instants(order, first, index, chain, chains, np.where(begins, 0.0, step), seconds)


#: A jump is judged by the medians of so many instants before and after it; beyond so many of their usual differences.
BESIDE, FAR_OFF = 5, 6.0
#: Across a jump the errors are known as little as after so many steps.
ACROSS = 1e3


def jumps_in(residual: Array, instants: Instants) -> np.ndarray:
    """The instants (J,) at which a track's residuals (N, 6) step from one level to another: where a loop was closed."""
    if instants.chains > 1 or instants.count < 8 * BESIDE:
        return np.zeros(0, dtype=np.int64)
    each = residual[instants.first]
    windows = np.median(np.lib.stride_tricks.sliding_window_view(each, BESIDE, axis=0), axis=2)
    step = windows[BESIDE:] - windows[:-BESIDE]  # of instant k + BESIDE, from the one before it
    begins = np.convolve(instants.step == 0.0, np.ones(2 * BESIDE - 1))[2 * BESIDE - 1 : -1][: len(step)] > 0
    usual = np.median(np.abs(step - np.median(step, axis=0)), axis=0) / 0.6745
    score = (np.abs(step) / np.maximum(usual, 1e-12)).max(axis=1) * ~begins
    found = []
    while len(score) and score.max() > FAR_OFF:
        k = int(np.argmax(score))
        found.append(k + BESIDE)
        score[max(k - BESIDE, 0) : k + BESIDE + 1] = 0.0
    return np.sort(np.array(found, dtype=np.int64))


def standstills(A: Array, stamps: np.ndarray) -> np.ndarray:
    """The standstill (N,) of each instant: poses (N, 12) that stay within ``STILL`` of its first have one error."""
    order = np.lexsort((A[:, 0], stamps))
    poses, later = A[order], np.diff(stamps[order]) > 0
    begins = np.ones(len(A), dtype=bool)
    end = 0
    for i in np.flatnonzero(later & (np.abs(np.diff(poses, axis=0)) < STILL).all(axis=1)).tolist():
        if i < end:
            continue
        end = i + 1
        while end < len(A) and later[end - 1] and (np.abs(poses[end] - poses[i]) < STILL).all():
            begins[end] = False
            end += 1
    place = np.empty(len(A), dtype=np.int64)
    place[order] = np.cumsum(begins) - 1
    return place


def stations(A: Array) -> np.ndarray:
    """The station (N,) of each instant: where an arm comes back to few poses (N, 12), its error there is the same.

    Poses near one another are one station, if all are far from those of other stations and if each is visited twice and
    more on average. Elsewhere each instant is a station of its own. Lengths count in units of the motion's spread.
    """
    alone = np.arange(len(A))
    spread = float(np.sqrt((A[:, 3::4].var(axis=0)).mean()))
    poses = A.copy()
    poses[:, 3::4] *= SPREAD_M / max(spread, SMALLEST_SPREAD)
    tree = None
    some = np.random.default_rng(0).permutation(poses)[:SAMPLED]
    squares = (some**2).sum(axis=1)[:, None] + (poses**2).sum(axis=1) - 2.0 * some @ poses.T
    for near in REVISITED:
        neighbours = (squares < (APART * near) ** 2).sum(axis=1) - 1
        if neighbours.mean() > 2.0 * MOST_LINKS:
            return alone
        if (neighbours > 0).mean() < FEWEST_REVISITED:
            continue
        from scipy.sparse import coo_array  # here, since few motions need them
        from scipy.sparse.csgraph import connected_components
        from scipy.spatial import cKDTree

        tree = tree or cKDTree(poses)
        links = tree.query_pairs(APART * near, output_type="ndarray")
        graph = coo_array((np.ones(len(links)), (links[:, 0], links[:, 1])), shape=(len(A), len(A)))
        count, station = connected_components(graph, directed=False)
        visits = np.bincount(station, minlength=count)
        middle = np.stack([np.bincount(station, column, count) / visits for column in poses.T], axis=1)
        if 2 * count <= len(A) and (np.linalg.norm(poses - middle[station], axis=1) < near).all():
            return np.asarray(station)
    return alone


@dataclass(frozen=True)
class Rows:
    """The linear model about one estimate, in the order of its instants."""

    instants: Instants
    #: (N, 6)
    residual: Array
    #: Its derivative by the d unknowns, in the order of ``Variables.unknowns``.
    by_unknowns: SparseColumns
    #: (N, 6, 6): B's covariance as stated; without weights 0.5 rad^2 (kappa = 1) and 1 m^2.
    given: Array
    #: (N, 3): The sensor's z axis in the target's frame.
    axis: Array
    #: (N, 6, 6) each. E: by a twist of A on either side.
    twist: dict[About, Array]
    #: (N, 12) each. Rotation and translation of the moving carrier, by ``SMOOTH_RAD`` and ``SMOOTH_M``.
    configuration: dict[About, Array]
    #: (N, 6): The residual's change for a stamp that is one second late; zero where the velocity is not known.
    rate: Array
    #: (N, 4, 4): T_sensor_target, lengths as measured.
    predicted: Array
    #: (N, 3): The residual's change by the logarithm of the track's scale.
    length: Array
    #: (N, 4, 4): A.
    carriers: Array
    #: (N, 6, 6): The covariance of directions in which nothing is measured, whatever the noise.
    slides: Array | None

    @staticmethod
    def of(
        data: list[PairData],
        variables: Variables,
        state: State,
        layout: JointCovariance,
        instants: Instants,
        noisy: Array | None = None,
    ) -> Rows:
        """The rows at an estimate; ``layout`` has the places of the unknowns.

        ``noisy`` (N, 6), in the order of the instants, is the noise of S = Y^-1 A X: derivatives are then without it.
        """
        at = linearized(data, variables, state)
        every = [at[item.pair] for item in data]
        counts = [item.count for item in data]
        residual, right = (np.concatenate([getattr(of, part) for of in every]) for part in ("residual", "carrier"))
        if noisy is not None:
            of_data = np.empty_like(noisy)
            of_data[instants.order] = noisy
            every = _without_noise(every, residual, of_data, np.concatenate([item.covariance for item in data]))
        jacobians = [jacobian_of(item, linear, variables, layout) for item, linear in zip(data, every, strict=True)]
        frames = {name: pose.matrix() for name, pose in (state.X | state.Y).items()}
        X, Y = (np.repeat([frames[item.pair[i]] for item in data], counts, axis=0) for i in (0, 1))
        scales = [variables.scale_of_pair.get(item.pair) for item in data]
        A, B = (np.concatenate([getattr(item.residuals, letter) for item in data]) for letter in "AB")
        inverse, predicted = se3.inverse(A), np.linalg.inv(Y) @ A @ X
        alpha = [1.0 if scale is None else state.scales[scale] for scale in scales]
        predicted[:, :3, 3] *= np.repeat(alpha, counts)[:, None]
        given = np.concatenate([item.measured for item in data])
        slides = np.concatenate([item.covariance for item in data]) - given
        has_slides = any(item.slides is not None for item in data)
        # A Expmap(e) on the target carrier's side; Expmap(e) A = A Expmap(Ad(A^-1) e) on the sensor carrier's.
        parts = [
            residual, given, B[:, 2, :3], right, right @ se3.adjoint(inverse), _configuration(A),
            _configuration(inverse), predicted, se3.inverse(predicted)[:, :3, 3], A,
        ]  # fmt: skip
        stacked = [part[instants.order] for part in parts]
        residual, given, axis, right, left, moving_target, moving_sensor, predicted, length, A = stacked
        by_unknowns = SparseColumns.of(jacobians, len(layout.unit))[instants.order]
        rate = np.einsum("nij,nj->ni", right, _velocity(A, instants))
        return Rows(
            instants, residual, by_unknowns, given, axis, {"targetcarrier": right, "sensorcarrier": left},
            {"targetcarrier": moving_target, "sensorcarrier": moving_sensor}, rate, predicted, length, A,
            slides[instants.order] if has_slides else None,
        )  # fmt: skip

    @property
    def jacobian(self) -> Array:
        """The derivative (N, 6, d) by all unknowns."""
        return self.by_unknowns.whole

    @property
    def typical_given(self) -> tuple[float, float]:
        """The standard deviations of rotations and translations as given, over all axes that are measured: rad, m."""
        variances = np.maximum(np.einsum("nii->ni", self.given), 0.0)
        has = variances > 0.0
        by_axis = np.sqrt(variances.sum(axis=0) / np.maximum(has.sum(axis=0), 1))
        rotation, translation = (float(of[of > 0.0].mean()) if of.any() else 1.0 for of in (by_axis[:3], by_axis[3:]))
        return rotation, translation

    def thinned(self, every: int) -> Rows:
        """The rows of every so-many-th instant of each track."""
        step = self.instants.step
        track, begins = np.cumsum(step == 0.0) - 1, np.flatnonzero(step == 0.0)
        return self.of_instants((np.arange(len(step)) - begins[track]) % every == 0)

    def of_instants(self, kept: np.ndarray) -> Rows:
        """The rows of some instants, a mask (T,); a track begins at the first of it that is kept."""
        instants = self.instants
        track, walked = np.cumsum(instants.step == 0.0)[kept], np.cumsum(instants.step)[kept]
        rows = kept[instants.index]
        step = np.where(np.diff(track, prepend=-1) != 0, 0.0, np.diff(walked, prepend=0.0))
        _, index = np.unique(instants.index[rows], return_inverse=True)
        fewer = Instants(
            instants.order[rows], np.flatnonzero(np.r_[True, np.diff(index) != 0]), index, instants.chain[rows],
            instants.chains, step, None if instants.seconds is None else instants.seconds[kept],
        )  # fmt: skip
        return Rows(fewer, *(_taken(getattr(self, part.name), rows) for part in fields(self)[1:]))

    def in_one_track(self) -> Rows:
        """The same rows, whose measurements of an instant share its drift: one track for each body."""
        bodies = self.instants.bodies
        return replace(
            self, instants=replace(self.instants, chain=bodies[self.instants.chain], chains=int(bodies.max()) + 1)
        )

    def features(self, side: About) -> Array:
        """f (N, k): the centred principal components of the configurations."""
        centred = self.configuration[side] - self.configuration[side].mean(axis=0)
        # Of a motion that is wider than an arm's, the spread is the length.
        spread = SMOOTH_M * float(np.sqrt((centred[:, 9:] ** 2).mean()))
        centred[:, 9:] *= min(1.0, SPREAD_M / max(spread, SMALLEST_SPREAD))
        _, s, directions = np.linalg.svd(centred, full_matrices=False)
        kept = s**2 > SMALLEST_SPREAD * max(float((s**2).sum()), 1e-300)
        found: Array = centred @ directions[kept].T
        return found


def _without_noise(every: list[Linearization], residual: Array, noisy: Array, given: Array) -> list[Linearization]:
    """The derivatives by X and Y where residuals (N, 6) are nothing, and at S Expmap(-noisy).

    With r = Log(B^-1 S), S = Y^-1 A X, they are Jr^-1(r) and -Jr^-1(r) Ad(S^-1). Noise of A is in S, and in r: together
    they say that Y is where it is taken to be. Without all of the white noise S would be B, which has its own; in the
    middle both weigh the same, with opposite signs. Where B's covariance is not the same along all axes, it is of B's
    axes, and derivatives must be too: a depth that B's noise turns is a side, which is known a hundred times better.
    """
    left = se3.logmap(se3.expmap(residual) @ se3.expmap(-noisy))
    blocks = np.stack([given[:, :3, :3], given[:, 3:, 3:]], axis=1)
    sizes = np.einsum("nkii->nk", blocks)[..., None, None] / 3.0
    alike = (np.abs(blocks - sizes * np.eye(3)) < ALIKE * sizes).all(axis=(1, 2, 3))
    straight = np.linalg.inv(se3.right_jacobian_inverse(residual))
    turned = se3.adjoint(se3.expmap(noisy)) @ straight
    of_B = se3.right_jacobian_inverse(left) @ turned
    target = np.where(alike[:, None, None], straight, of_B) @ np.concatenate([linear.target for linear in every])
    sensor = np.where(alike[:, None, None], turned, of_B) @ np.concatenate([linear.sensor for linear in every])
    ends = np.cumsum([len(linear.residual) for linear in every])[:-1]
    parts = zip(every, np.split(target, ends), np.split(sensor, ends), strict=True)
    return [replace(linear, target=by_X, sensor=by_Y) for linear, by_X, by_Y in parts]


def _taken(part: Any, rows: np.ndarray) -> Any:
    """Some rows of a part, or of each side of it; None of none."""
    if part is None:
        return None
    return {side: of[rows] for side, of in part.items()} if isinstance(part, dict) else part[rows]


def _configuration(moving: Array) -> Array:
    R, t = moving[:, :3, :3].reshape(len(moving), 9), moving[:, :3, 3]
    return np.hstack([R / (np.sqrt(2.0) * SMOOTH_RAD), t / SMOOTH_M])


def _velocity(A: Array, instants: Instants) -> Array:
    """The carriers' velocity (N, 6) at each measurement, from the poses before and after; zero where these are far."""
    velocity = np.zeros((instants.count, 6))
    if instants.seconds is not None and instants.count >= 3:
        poses, t = A[instants.first], instants.seconds
        linked = (instants.step[1:-1] > 0.0) & (instants.step[2:] > 0.0)
        apart = t[2:] - t[:-2]
        near = linked & (apart > 0.0) & (apart <= 2.0 * NEIGHBOURS_S)
        moved = se3.logmap(se3.inverse(poses[:-2]) @ poses[2:])
        velocity[1:-1] = np.where(near[:, None], moved / np.where(near, apart, 1.0)[:, None], 0.0)
    found: Array = velocity[instants.index]
    return found


#: Columns that are at most so many times as many as each row has are kept whole: one product is then faster.
FEW = 2


@dataclass(frozen=True)
class SparseColumns:
    """The numbers of some rows in columns that are zero elsewhere."""

    #: (N, 6, w)
    values: Array
    #: (N, w): The column of each number; a row's columns may be named twice, and then add up.
    places: np.ndarray
    #: The number of all columns.
    count: int

    @staticmethod
    def of(blocks: list[tuple[Array, np.ndarray]], count: int) -> SparseColumns:
        """Blocks of rows (n, 6, w_i), each with its columns (w_i,), one after the other."""
        width = max((len(places) for _, places in blocks), default=0)
        is_whole = count <= FEW * width
        values = np.zeros((sum(len(J) for J, _ in blocks), 6, count if is_whole else width))
        columns = np.zeros((len(values), values.shape[2]), dtype=np.int64)
        if is_whole:
            columns[:] = np.arange(count)
        first = 0
        for J, places in blocks:
            rows = slice(first, first + len(J))
            if is_whole:
                values[rows, :, places] = J
            else:
                values[rows, :, : len(places)] = J
                columns[rows, : len(places)] = places
            first += len(J)
        return SparseColumns(values, columns, count)

    def __getitem__(self, rows: np.ndarray) -> SparseColumns:
        """Those of some rows."""
        return SparseColumns(self.values[rows], self.places[rows], self.count)

    @property
    def is_whole(self) -> bool:
        """Whether every row has all columns, in their order."""
        return self.values.shape[2] == self.count and bool((self.places == np.arange(self.count)).all())

    @property
    def whole(self) -> Array:
        """All columns (N, 6, count)."""
        if self.is_whole:
            return self.values
        found = np.zeros((len(self.values), 6, self.count))
        rows = np.arange(len(self.values))
        for k in range(self.values.shape[2]):
            found[rows, :, self.places[:, k]] += self.values[:, :, k]
        return found

    def by(self, basis: Array) -> SparseColumns:
        """The columns in another basis (count, p) of them; few of each row again where it only scales."""
        unit = np.diagonal(basis)
        if basis.shape[0] == basis.shape[1] and not (basis - np.diag(unit)).any():
            return SparseColumns(self.values * unit[self.places][:, None], self.places, self.count)
        values = self.whole @ basis
        p = values.shape[2]
        return SparseColumns(values, np.broadcast_to(np.arange(p), (len(values), p)), p)

    def gram(self, weights: Array) -> Array:
        """J' J (count, count) of the rows with their equations divided by ``weights`` (6,)."""
        scaled = self.values / weights[:, None]
        if self.is_whole:
            flat = scaled.reshape(-1, self.count)
            whole: Array = flat.T @ flat
            return whole
        at = self.places[:, :, None] * self.count + self.places[:, None]
        return summed(scaled.transpose(0, 2, 1) @ scaled, at, (self.count, self.count))


def summed(values: Array, places: np.ndarray, shape: tuple[int, ...]) -> Array:
    """An array whose entries are the sums of the values at these places of its flat form."""
    found = np.bincount(places.ravel(), values.ravel(), int(np.prod(shape)))
    return found.reshape(shape).astype(np.float64, copy=False)  # counts of none are integers


def prior_terms(problem: Problem, variables: Variables, state: State, basis: Array) -> tuple[Array, Array, float]:
    """Information (p, p), gradient (p,) and value of kappa_0 theta^2 + |t - t_0|^2 / 2 sigma_0^2, by the basis.

    And those of the clocks' rates.
    """
    graph, values = gtsam.NonlinearFactorGraph(), variables.values(state)
    add_priors(graph, variables, problem, "geodesic")
    information, gradient = normal_equations_of(graph, values, variables)
    cost = graph.error(values)
    slots = slots_of(variables.unknowns)
    for name, rate in state.rates.items():
        place = slots[Unknown(UnknownKind.CLOCK_RATE, name)]
        information[place, place] += RATE**-2
        gradient[place] += rate / RATE**2
        cost += 0.5 * (rate / RATE) ** 2
    known = np.flatnonzero(information.any(axis=0))  # few have priors
    return basis[known].T @ information[np.ix_(known, known)] @ basis[known], basis.T @ gradient, cost
