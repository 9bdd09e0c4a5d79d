"""``rw.Stream``: measurements come one by one, and after each the answer, its proof and its covariances are there."""

from __future__ import annotations

import time
from dataclasses import dataclass, field
from functools import partial
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike
from rwhec_factors.batch import BatchResiduals
from scipy.special import fdtri

from gtsam_rwhec.calibration.calibrate_options import CalibrateOptions
from gtsam_rwhec.calibration.calibration_record import Calibration
from gtsam_rwhec.calibration.point_uncertainty import Carriers
from gtsam_rwhec.calibration.stages import calibrate
from gtsam_rwhec.capture.stream_answer import NoiseShown, PartAnswer, answered, noise_of
from gtsam_rwhec.capture.stream_store import STATED, Store
from gtsam_rwhec.capture.stream_update import StreamUpdate, poses_of
from gtsam_rwhec.errors import OptionError, RwhecError, ScaleError, UnderdeterminedError
from gtsam_rwhec.files.progress import Progress
from gtsam_rwhec.files.terminal_text import brief
from gtsam_rwhec.fitting.admission import DOF, inlier_threshold, rejected_share
from gtsam_rwhec.fitting.fit_options import check_choices
from gtsam_rwhec.fitting.robust_solution import SPARE, Steps, TruncatedLeastSquares
from gtsam_rwhec.fitting.unknowns import Unknown, UnknownKind, rows_of, slots_of
from gtsam_rwhec.fitting.weighted_fit import WeightedFit
from gtsam_rwhec.geometry.blas_threads import one_blas_thread
from gtsam_rwhec.geometry.poses import Array, PoseLike, one_transform
from gtsam_rwhec.geometry.real_numbers import check_kind, is_real, is_whole
from gtsam_rwhec.problem.additions import seen_pair
from gtsam_rwhec.problem.measurements import GivenMeasurements, Pair
from gtsam_rwhec.problem.problem import Problem
from gtsam_rwhec.problem.selection import AS_STATED, VarianceFactors, of_moments
from gtsam_rwhec.solver.certificate import Certificate
from gtsam_rwhec.solver.parts import connected_components, parts_of
from gtsam_rwhec.solver.solve_options import SolveOptions

Keep = Literal["measurements", "moments"]
StreamNoise = Literal["estimate", "given"]

#: Weights have the variances of the noise, each rounded to a power of this: what an estimate's chance changes of them
#: does not matter, and they do not depend on how the measurements came.
STEP = 1.25
#: Who does not count comes back when the square of its residual is below this share of what it must exceed to leave:
#: else what is near the limit would go and come.
BACK = 0.8
#: All measurements are judged again when their number has grown by this share since, so that each costs the same.
JUDGED_AGAIN = 1.0 / 64.0
#: Outliers are looked for without regard to the last answer at so many measurements, and whenever these doubled. It
#: takes some dozens of fits: an update makes one, or more where frames, and so many measurements, are together fewer.
FIRST_SEARCH, SLICE, AS_A_FRAME = 8, 32, 256


@dataclass(frozen=True)
class StreamOptions:
    """The options of a stream."""

    #: "measurements": the raw ones are kept in compact arrays (300 bytes each, 590 with covariances), as a final answer
    #: that equals the batch's needs. "moments": the last ``window`` to twice ``window`` of them and the sums of all, so
    #: that memory does not grow; a verdict on older ones is final, and they cannot be removed.
    keep: Keep = "measurements"
    window: int = 256
    #: "estimate": from the residuals; what is stated gives the ratios. "given": as stated.
    noise: StreamNoise = "estimate"
    robust: bool = True  #: Whether measurements that contradict the others are left out
    #: Probability that a good measurement is kept, at least: all good ones together are kept with 95 %
    inlier_confidence: float = 0.997
    solve: SolveOptions = field(default_factory=SolveOptions)  #: Of the certified solver

    def __post_init__(self) -> None:
        check_choices(self, {"keep": Keep, "noise": StreamNoise})
        if not is_whole(self.window, 16):
            raise OptionError(f"StreamOptions.window={brief(self.window)}; give a whole number from 16")
        if not isinstance(self.robust, bool) or not isinstance(self.solve, SolveOptions):
            raise OptionError("StreamOptions.robust is True or False, and solve a SolveOptions")
        confidence = self.inlier_confidence
        if not (is_real(confidence) and 0.5 < confidence < 1.0):
            raise OptionError(f"StreamOptions.inlier_confidence={brief(confidence)}; give one between 0.5 and 1")


class Stream:
    """A calibration while it is measured: each ``add`` returns what all measurements so far say.

    Measurements may come in any order and from several sensors. Each update descends from the last answer on moments
    that one measurement changed, and certifies the part of the graph that it touched by the same rigorous bound as
    ``rw.solve``; so it costs the same after a million measurements. What they leave undetermined is said; frames with
    too few measurements wait.

    A measurement is judged when it comes, by the noise and the covariance of the answer before it; all are judged again
    when their number has grown by 1/64, and without regard to the last answer whenever it doubled. So a late verdict
    may take back an early one.

    Parameters
    ----------
    knowledge : Problem, optional
        A problem without measurements: its scale mode, fixed frames, priors, known sizes, names of carriers.
    options : StreamOptions, optional
    """

    def __init__(self, knowledge: Problem | None = None, *, options: StreamOptions | None = None) -> None:
        knowledge = Problem() if knowledge is None else knowledge
        if not isinstance(knowledge, Problem) or knowledge.pairs:
            raise OptionError("knowledge is a gtsam_rwhec.Problem without measurements; give these to Stream.add")
        check_kind(options, StreamOptions | None, "options", "a gtsam_rwhec.StreamOptions")
        self.options = options or StreamOptions()
        self._store = Store(knowledge, None if self.options.keep == "measurements" else self.options.window)
        self._weights: VarianceFactors = AS_STATED
        self._noise: NoiseShown | None = None
        self._parts: dict[tuple[str, ...], PartAnswer | str] = {}
        self._rotations: dict[str, Array] = {}
        self._judged_at = self._searched_at = 0
        #: A search that is under way, and the numbers of the measurements in it, in the order of its problem.
        self._search: tuple[Steps[tuple[WeightedFit, np.ndarray]], np.ndarray] | None = None
        self._removed, self._is_settled = 0, True
        self._last = self._updated(None, time.perf_counter(), np.empty(0))

    @property
    def last(self) -> StreamUpdate:
        """The last update."""
        return self._last

    @one_blas_thread()
    @np.errstate(all="ignore")
    def add(
        self,
        *,
        target: str,
        sensor: str,
        T_sensorcarrier_targetcarrier: PoseLike,
        T_sensor_target: PoseLike,
        stamp_ns: int | None = None,
        sigma: float | None = None,
        kappa: float | None = None,
        covariance: ArrayLike | None = None,
    ) -> StreamUpdate:
        """Take one measurement, and say what all of them say now.

        Parameters
        ----------
        target, sensor : str
            Names, unique across targets and sensors; a sensor's name twice for a motion of its own (A Y = Y B).
        T_sensorcarrier_targetcarrier, T_sensor_target : (4, 4) array or gtsam.Pose3
            A and B, metres.
        stamp_ns : int, optional
            Nanoseconds. The final problem has measurements in their order; without stamps, in that of arrival.
        sigma, kappa, covariance : optional
            As in ``Problem.add``. All measurements of a stream state the same of these and the stamp.

        Raises
        ------
        FrameError, PoseError, NoiseError, StampError
            A name, pose or weight is not valid, or other things are stated than before; nothing is taken then.
        """
        start = time.perf_counter()
        pair = Pair(target, sensor) if target == sensor else seen_pair(target, sensor)
        poses = {"A": T_sensorcarrier_targetcarrier, "B": T_sensor_target}
        A, B = (one_transform(T, f"{name} of {pair}")[None] for name, T in poses.items())
        stamps = None if stamp_ns is None else np.array([stamp_ns])
        given = GivenMeasurements(A, B, sigma, kappa, None, stamps, covariance, None)
        raw = given.checked(f"measurement {self._store.number} of {pair}")
        each = zip(STATED, (sigma, kappa, stamp_ns, covariance), strict=True)
        place = self._store.append(pair, raw, frozenset(name for name, value in each if value is not None))
        number = int(self._store.rows["number"][place])
        if self._agrees(place, pair):
            self._store.let_count(np.array([place]), counts=True)
        return self._follow(number, {pair}, start)

    @one_blas_thread()
    @np.errstate(all="ignore")
    def remove(self, number: int | None = None) -> StreamUpdate:
        """Undo a measurement, by its number (``StreamUpdate.number``), or the last one: as if it had never come.

        Raises MeasurementsNotKeptError where it is not kept, or was removed before.
        """
        start, rows = time.perf_counter(), self._store.rows
        if number is None:
            number = int(rows["number"][-1]) if len(rows) else -1
        place = self._store.place_of(number)
        pair = self._store.pairs[int(rows["pair"][place])]
        self._store.forget(place)
        self._removed += 1
        return self._follow(number, {pair}, start)

    @property
    def problem(self) -> Problem:
        """A problem of all measurements, as a batch states it: pairs by name, each in the order of stamps.

        With ``keep="moments"`` it has the moments of those that count.
        """
        if self.options.keep == "measurements":
            return self._store.problem()
        return self._store.moments(AS_STATED)

    def calibrate(self, options: CalibrateOptions | None = None, *, progress: Progress | None = None) -> Calibration:
        """``rw.calibrate`` of ``problem``: the final answer, with all that only a batch asks."""
        return calibrate(self.problem, options, progress=progress)

    # -- one update ---------------------------------------------------------------------------------------------

    def _follow(self, number: int, changed: set[Pair], start: float) -> StreamUpdate:
        """Let answer, weights and verdicts follow each other until they stay."""
        store = self._store
        before = store.rows["counts"].copy()
        if store.choose_gauge():
            changed |= set(store.pairs)
        self._answer(changed)
        reweighted = self._weights_follow()
        changed = self._judge_again(search=not reweighted)
        if reweighted:
            changed = set(store.pairs)
        self._is_settled = not changed  # else the next update judges at once
        if changed:
            self._answer(changed)
        differ = np.flatnonzero(before != store.rows["counts"])
        self._last = self._updated(number, start, store.rows[differ])
        store.fold()
        return self._last

    def _updated(self, number: int | None, start: float, differ: np.ndarray) -> StreamUpdate:
        store, answers = self._store, self._answers
        rows, knowledge = store.rows, store.knowledge
        is_estimated = self.options.noise == "estimate" and len(rows) > 0
        X, Y, scales = poses_of(answers, knowledge)
        scale: float | dict[str, float] = 1.0
        if knowledge.scale == "shared":
            scale = answers[0].solution.answer.scale if answers else np.nan
        elif knowledge.scale == "per_target":
            scale = {pair.target: scales[pair.target] for pair in store.pairs if pair.target in scales}
        return StreamUpdate(
            number=number,
            counts=bool(len(rows) and number == rows["number"][-1] and rows["counts"][-1]),
            measurements=store.number - self._removed,
            counting=store.count,
            X=X,
            Y=Y,
            scale=scale,
            certificate=Certificate.merged([a.solution.certificate for a in answers]) if answers else None,
            free_directions=tuple(d for a in answers for d in a.solution.identifiability.free_directions),
            waiting={names: why for names, why in self._parts.items() if isinstance(why, str)},
            noise_factors=self._weights,
            left_out=tuple(differ["number"][~differ["counts"]].tolist()) if len(differ) else (),
            taken_back=tuple(differ["number"][differ["counts"]].tolist()) if len(differ) else (),
            is_settled=self._is_settled and self._search is None,
            seconds=time.perf_counter() - start,
            _out=store.left_out(),
            _pairs=tuple(store.pairs),
            _has_stamps=store.has_stamps,
            _parts=tuple(answers),
            _noise=self._noise,
            _carriers=Carriers(knowledge.sensor_carrier, knowledge.target_carrier),
            _scale_mode=knowledge.scale,
            _counting=partial(store.as_now().problem, np.flatnonzero(rows["counts"])) if is_estimated else None,
            _is_whole=store.is_whole,
        )

    def _answer(self, changed: set[Pair]) -> None:
        """Solve the parts that changed."""
        store, known = self._store, self._parts
        self._parts = {}
        if not store.count:
            return
        problem = store.moments(self._weights)
        problem.is_relative = store.is_relative and self._noise is None
        components = [tuple(component) for component in connected_components(problem.pairs)]
        if problem.scale == "shared":
            components = [tuple(name for component in components for name in component)]
        for names in components:
            pairs = tuple(pair for pair in problem.pairs if pair.sensor in names)
            if names in known and not changed.intersection(pairs):
                self._parts[names] = known[names]
                continue
            try:
                own = of_moments(problem, pairs, problem.moment_stack(pairs), problem.gauge)
                (part,) = parts_of(own)
                self._parts[names] = answer = answered(part, self._rotations, self.options.solve)
                self._rotations |= dict(zip(part.free, answer.solution.answer.R, strict=True))
            except (UnderdeterminedError, ScaleError) as error:
                self._parts[names] = str(error)
        self._noise = self._noise_now()

    @property
    def _answers(self) -> list[PartAnswer]:
        return [part for part in self._parts.values() if isinstance(part, PartAnswer)]

    def _noise_now(self) -> NoiseShown | None:
        if self.options.noise == "given":
            return None if self._store.is_relative else NoiseShown(AS_STATED, (np.inf, np.inf))
        return noise_of(self._answers, self._weights) if self._answers else None

    def _weights_follow(self) -> bool:
        """Whether the weights changed: they are those of the noise, by steps, whatever they were before."""
        if self._noise is None:
            return False
        steps = np.round(np.log(self._noise.factors) / np.log(STEP))
        weights = VarianceFactors(*(STEP**steps).tolist())
        changed, self._weights = weights != self._weights, weights
        return changed

    # -- verdicts -----------------------------------------------------------------------------------------------

    @property
    def _can_judge(self) -> bool:
        """Whether there are equations enough to tell an outlier."""
        spare = DOF * (self._store.count - 1) - sum(answer.part.number_of_unknowns for answer in self._answers)
        return self.options.robust and self._noise is not None and spare >= SPARE

    def _threshold(self, count: int) -> float:
        """The largest square of a residual that agrees, of all."""
        assert self._noise is not None
        nu = min(self._noise.degrees_of_freedom)
        if np.isinf(nu):
            return inlier_threshold(self.options.inlier_confidence, count)
        return DOF * float(fdtri(DOF, max(nu, 1.0), 1.0 - rejected_share(self.options.inlier_confidence, count)))

    def _agrees(self, place: int, pair: Pair) -> bool:
        """Whether a new measurement agrees with the answer before it: e' (V + J C J')^-1 e, as ``admission`` says."""
        rows = self._store.rows[place : place + 1]
        answer = next((a for a in self._answers if set(pair) <= set(a.part.names)), None)
        if answer is None or not self._can_judge or answer.free.shape[1]:
            return True
        X, Y, scales = poses_of([answer], self._store.knowledge)
        ends = X if not pair.is_motion else Y
        alpha = scales[pair.target]
        at = BatchResiduals(rows["A"], rows["B"]).linearize(ends[pair.target].matrix(), Y[pair.sensor].matrix(), alpha)
        slots = slots_of(answer.unknowns)
        by_unknown = [
            (Unknown(UnknownKind.FRAME, pair.target), at.target[0]),
            (Unknown(UnknownKind.FRAME, pair.sensor), at.sensor[0]),
            (Unknown(UnknownKind.SCALE, pair.target), at.scale.T),
            (Unknown(UnknownKind.SCALE), at.scale.T),
        ]
        there = [(unknown, J) for unknown, J in by_unknown if unknown in slots]
        J = np.zeros((DOF, len(answer.unit)))
        for unknown, block in there:
            J[:, rows_of(slots, [unknown])] += block
        assert self._noise is not None
        f = np.array(self._noise.factors) / np.array(self._weights)
        V = self._variances(np.array([place]))[0] + J @ answer.covariance(f) @ J.T
        square = float(at.residual[0] @ np.linalg.solve(V, at.residual[0]))
        rows["square"], rows["judged"] = square, self._store.number
        return square <= self._threshold(self._store.number)

    def _variances(self, places: np.ndarray) -> Array:
        """(N, 6, 6): the covariances of B of some rows, under the noise that all show."""
        assert self._noise is not None
        deviation = np.sqrt(np.repeat(self._noise.factors, 3))
        own: Array = self._store.measurements(places).covariance_of_B() * deviation[:, None] * deviation
        return own

    def _judge_again(self, *, search: bool) -> set[Pair]:
        """Judge all measurements by the answer, if it is time to; the pairs of which some verdicts changed.

        A search that is under way goes on if ``search``.
        """
        store, now = self._store, len(self._store.rows)
        if not self._can_judge or not now:
            return set()
        if self.options.keep == "measurements" and now >= max(FIRST_SEARCH, 2 * self._searched_at):
            self._searched_at = now
            order = np.concatenate([places for _, places in store.sorted_rows()])
            work = TruncatedLeastSquares(store.problem(), self.options.inlier_confidence)
            self._search = work.run(self.options.noise), store.rows["number"][order]
            self._judged_at = 0  # all are judged once it has ended
        counts = self._searched_on() if self._search is not None and search else None
        if self._search is not None:
            return set()
        if counts is None:
            if self._is_settled and self._judged_at <= now < self._judged_at * (1.0 + JUDGED_AGAIN):
                return set()
            self._judged_at = now
            counts = self._by_residuals()
        changed = np.flatnonzero(counts != store.rows["counts"])
        for value in (False, True):
            store.let_count(changed[counts[changed] == value], counts=value)
        return {store.pairs[e] for e in store.rows["pair"][changed].tolist()}

    def _by_residuals(self) -> np.ndarray:
        """Which rows agree with the answer; those of frames without an answer count."""
        store = self._store
        rows = store.rows
        X, Y, scales = poses_of(self._answers, store.knowledge)
        poses = {name: pose.matrix() for name, pose in (X | Y).items()}
        known = np.array([pair.target in poses and pair.sensor in poses for pair in store.pairs])[rows["pair"]]
        own = rows[known]
        first, second = (np.array([poses.get(pair[i], np.eye(4)) for pair in store.pairs])[own["pair"]] for i in (0, 1))
        alpha = np.array([scales.get(pair.target, 1.0) for pair in store.pairs])[own["pair"]]
        e = BatchResiduals(own["A"], own["B"]).residuals(first, second, alpha)
        square = np.einsum(
            "ni,ni->n", e, np.linalg.solve(self._variances(np.flatnonzero(known)), e[:, :, None])[:, :, 0]
        )
        rows["square"][known], rows["judged"] = square, store.number
        counts = np.ones(len(rows), dtype=bool)
        counts[known] = square <= self._threshold(store.number) * np.where(own["counts"], 1.0, BACK)
        return counts

    def _searched_on(self) -> np.ndarray | None:
        """Which rows agree, once a search without regard to the last answer has ended; None on its way.

        What came since it began keeps its verdict: it is judged by the new answer next.
        """
        assert self._search is not None
        (steps, numbers), rows = self._search, self._store.rows
        work = 1 + len(self._rotations) + len(numbers) // AS_A_FRAME
        try:
            for _ in range(max(1, SLICE // work)):
                next(steps)
        except StopIteration as end:
            self._search = None
            counts = rows["counts"].copy()
            place = np.minimum(np.searchsorted(rows["number"], numbers), len(rows) - 1)
            there = rows["number"][place] == numbers  # others were removed
            counts[place[there]] = end.value[1][there]
            return counts
        except (RwhecError, np.linalg.LinAlgError):  # too few agree: the verdicts so far stay
            self._search = None
        return None
