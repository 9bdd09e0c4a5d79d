"""What the data say of their noise, as a record that says so in words."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import gtsam
import numpy as np
from rwhec_factors import se3
from scipy.special import expit

from gtsam_rwhec.files.progress import Progress
from gtsam_rwhec.files.terminal_text import rounded
from gtsam_rwhec.fitting.block_agreement import Scatter
from gtsam_rwhec.fitting.clock_rates import ClockRate
from gtsam_rwhec.fitting.component_posterior import Mixture, mixture_of
from gtsam_rwhec.fitting.fit_options import CARRIER, DRIFT, SYSTEMATIC, About, CarrierNoise, Component, DriftFrame
from gtsam_rwhec.fitting.joint_covariance import JointCovariance
from gtsam_rwhec.fitting.lasting_errors import LastingErrors
from gtsam_rwhec.fitting.noise_search import (
    CORRELATED,
    MOST_TRACKS,
    Settled,
    Task,
    is_short,
    likeness_of_neighbours,
    moved,
    thinned,
    why_no_drift,
    with_drift,
)
from gtsam_rwhec.fitting.unknowns import State, Unknown, UnknownKind
from gtsam_rwhec.geometry.poses import Array

C = Component
#: A kind of noise is found where it raises twice the log likelihood by more than this, a parameter.
EVIDENCE = 5.0
#: Twice the log likelihood's rise that systematic errors of rotation and of translation must exceed.
MOST_BY_CHANCE = EVIDENCE * len(SYSTEMATIC)
#: Errors that last are told where they make variances larger by this factor.
TOLD_RATIO = 1.1
_UNITS = {
    C.JITTER: ("ms", 1e3), C.DRIFT_SCALE: ("%", 1e2),
    **dict.fromkeys((C.ROTATION, C.CARRIER_ROTATION, C.DRIFT_ROTATION, C.SYSTEMATIC_ROTATION), ("°", 180.0 / math.pi)),
    **dict.fromkeys(
        (C.TRANSLATION, C.DEPTH, C.CARRIER_TRANSLATION, C.DRIFT_TRANSLATION, C.SYSTEMATIC_TRANSLATION), ("mm", 1e3)
    ),
}  # fmt: skip

_OF_FRAME = {"detection": " of detections", "sensor": " in the sensor's frame", "target": " in the target's frame"}


def ratio_words(evidence: float) -> str:
    """A likelihood ratio: how much twice the log likelihood rose; a fall, which rounding and priors make, is none."""
    rise = max(evidence, 0.0)
    return f"evidence {rounded(rise) if rise < 10.0 else f'{rise:.0f}'}"


@dataclass(frozen=True)
class Deviation:
    """A component's standard deviation, with the interval that holds it with 90 % probability; rad, m, s or a ratio."""

    value: float
    low: float
    high: float


@dataclass(frozen=True)
class NoiseInData:
    """The noise that the data have."""

    deviations: dict[Component, Deviation]
    #: The carrier poses at which something was measured.
    instants: int
    #: As many instants with independent noise would determine the unknowns as well.
    worth: float
    #: The carrier to which errors of A are fixed.
    hand: About
    #: Of a track's errors from one step to the next; 1 is a random walk, None no drift.
    correlation: float | None
    #: In whose frame these errors are; "detection": rotations in the target's axes, translations along the sensor's.
    frame: DriftFrame | None
    #: How much twice the log likelihood rose with drift, and with errors that vary with the configuration.
    drift_evidence: float
    systematic_evidence: float
    #: Why no drift was looked for; empty where it was, or an option says that there is none.
    drift_not_sought: str
    is_short: bool  #: Whether tracks are too short to trust a model of drift
    #: Whether the order in time is known; without stamps it is that of rows.
    has_stamps: bool
    #: Whether residuals are correlated in time, and tracks are too many for a model of it, or too short to trust one.
    is_drift_doubted: bool
    #: Whether the covariance has a constant error of A, which no residual shows, tied to the part that varies.
    arms_assumed: bool
    #: That such errors are there: the covariance averages over both.
    systematic_probability: float
    #: Of the constant errors that the covariance has, [omega, v] in rad and m: of the targets' carrier in its own axes,
    #: A Expmap(c), and of the sensors', Expmap(c) A.
    constant_deviations: tuple[tuple[float, ...], ...] = ((0.0,) * 6,) * 2
    #: How much blocks of the log scatter, for each way to cut it; empty of few instants.
    scatter: tuple[Scatter, ...] = ()
    #: The one by which the covariance is larger; None where blocks agree.
    worst: Scatter | None = None
    #: What errors do that last; None of few measurements.
    lasting: LastingErrors | None = None
    #: How often the errors of a track jump: it was cut there.
    jumps: int = 0
    #: What is known of the rates of clocks along a path.
    clocks: tuple[ClockRate, ...] = ()
    #: By so many standard deviations the answer would still move; a settled one by next to nothing.
    farthest: float = 0.0

    @property
    def has_systematic(self) -> bool:
        """Whether the data show errors that vary with the configuration."""
        return self.systematic_evidence > MOST_BY_CHANCE

    @property
    def carrier_noise(self) -> CarrierNoise | None:
        """The noise of A, independent from measurement to measurement; None where A counts as exact."""
        if not all(component in self.deviations for component in (C.CARRIER_ROTATION, C.CARRIER_TRANSLATION)):
            return None
        rotation, translation = (self.deviations[c].value for c in (C.CARRIER_ROTATION, C.CARRIER_TRANSLATION))
        return CarrierNoise(rotation, translation, about=self.hand)

    @property
    def size_words(self) -> str:
        """How large the noise of B and of A is, in short."""
        said = f"{self.size_words_of_B} for B"
        if self.carrier_noise is None:
            return f"{said}; A counts as exact"
        return f"{said}, {self._size(C.CARRIER_ROTATION)} and {self._size(C.CARRIER_TRANSLATION)} for A"

    @property
    def size_words_of_B(self) -> str:
        """How large the noise of B is, in short."""
        return " and ".join(self._size(component) for component in self._of_B)

    @property
    def _of_B(self) -> list[Component]:
        """B's components; of points alone, no rotation is measured."""
        return [component for component in (C.ROTATION, C.TRANSLATION) if component in self.deviations]

    @property
    def systematic_words(self) -> str:
        """The size of the systematic errors, in words."""
        return (
            f"{self._words(C.SYSTEMATIC_ROTATION)} and {self._words(C.SYSTEMATIC_TRANSLATION)} between poses far apart"
        )

    @property
    def sentences(self) -> tuple[str, ...]:
        """What was found, each with its evidence."""
        said = [
            f"Noise of B for each axis: {' and '.join(self._words(each) for each in self._of_B)}, and on top "
            f"{self._words(C.DEPTH)} along the sensor's z axis."
        ]
        if any(component in self.deviations for component in CARRIER):
            said.append(
                f"Noise of A for each axis: {self._words(C.CARRIER_ROTATION)} and "
                f"{self._words(C.CARRIER_TRANSLATION)}"
                + (f"; jitter of stamps: {self._words(C.JITTER)}." if C.JITTER in self.deviations else ".")
                + " Only frames far from their carrier tell it from B's; the sum of both is known better."
            )
        if self.correlation is not None:
            steps = [self._words(component) for component in DRIFT if component in self.deviations]
            kind = "Drift in a step" if self.correlation == 1.0 else f"Correlated errors ({self.correlation:g} a step)"
            kind += _OF_FRAME.get(self.frame or "", " of the carriers' poses, which all tracks share")
            said.append(
                f"{kind}: {', '.join(steps)} ({ratio_words(self.drift_evidence)}). "
                f"{self.instants} frames are worth about {self.worth:.0f}."
            )
        elif self.worth < 0.8 * self.instants:
            said.append(f"{self.instants} frames are worth about {self.worth:.0f}.")
        if self.arms_assumed:
            found = "found" if self.has_systematic else "not found, and not excluded"
            said.append(
                f"Errors of A that vary with the configuration: {self.systematic_words}, {found} "
                f"({ratio_words(self.systematic_evidence)}): {100.0 * self.systematic_probability:.0f} % probable. "
                "Their constant part, which residuals do not show, is assumed to be twice as large: state the arm's "
                "accuracy if you know it."
            )
        said += [f"{clock}, which is taken off." for clock in self.clocks if clock.is_sure]
        if self.jumps:
            said.append(f"The errors jump {self.jumps} times, as where loops are closed; the track is cut there.")
        if self.lasting is not None and self.lasting.ratio > TOLD_RATIO:
            said.append(
                "Errors that last, of the view or in time, are "
                f"{100.0 * self.lasting.probability:.0f} % probable: they do not average out, and standard deviations "
                f"are {rounded(math.sqrt(self.lasting.ratio))} times as large."
            )
        if self.worst is not None:
            times = rounded(math.sqrt(self.worst.ratio))
            said.append(f"Blocks disagree: {self.worst}; so all standard deviations are {times} times as large.")
        elif self.scatter:
            said.append(f"Blocks agree: {self.scatter[0]}.")
        return tuple(said)

    def __str__(self) -> str:
        return " ".join(self.sentences)

    def _size(self, component: Component) -> str:
        unit, factor = _UNITS[component]
        separator = "" if unit == "°" else " "
        return f"{rounded(self.deviations[component].value * factor)}{separator}{unit}"

    def _words(self, component: Component) -> str:
        _, factor = _UNITS[component]
        of = self.deviations[component]
        return f"{self._size(component)} ({rounded(of.low * factor)} to {rounded(of.high * factor)})"


#: Where no drift can be tried, the verdict says so beyond this many deviations of the residuals' lag-1 correlation.
SURELY_CORRELATED = 8.0
#: Before the data, the hand is the carrier that is nearer to its frames: this times log of the ratio of distances.
NEARER = 4.0
#: An arm's constant error, over what varies with the configuration: in 300 simulated arms 1.4 to 3.1 (rotation) and
#: 0.9 to 1.9 (translation), by the spread of the configurations.
CONSTANT = 2.0
#: No arm's poses are farther apart (m). The constant error is then of a map, and of six bent
#: ones that were flown over this held all (chi2(6) of .6 to 2.2).
FARTHEST_M, CONSTANT_OF_TRACKER = 5.0, 0.5
#: Before the data, the odds that an arm has errors that matter beside the noise of detections: one in seven.
LOG_ODDS = -2.0


def settled(task: Task, start: State, tell: Progress, before: Settled | None = None) -> Settled:
    """The side of A's errors, the drift, and the optimum under them.

    ``before`` is the optimum for nearly the same measurements, whose side and drift are kept.
    """
    options = task.options
    if before is not None:
        tell("estimating the noise again")
        drift = before.model.drift
        again = task.settle(
            start, before.model.side, None if drift is None else drift.walk, systematic=options.systematic,
            near=before.fit,
        )  # fmt: skip
        return replace(before, state=again.state, model=again.model, fit=again.fit)
    sides: tuple[About, ...] = ("targetcarrier", "sensorcarrier") if options.side is None else (options.side,)
    tell("estimating the noise of A and B")
    tried = {side: task.settle(start, side, None, systematic=False) for side in sides}
    lengths = {"targetcarrier": start.X, "sensorcarrier": start.Y}
    nearer = NEARER if all(lengths.values()) else 0.0  # motions alone have frames on one side only
    score = {side: found.fit.objective + nearer * np.log(_distance(lengths[side])) for side, found in tried.items()}
    side, other = sorted(score, key=lambda each: score[each]) if len(score) > 1 else (sides[0], sides[0])
    white = steady = tried[side]
    if options.systematic:
        steady = task.settle(white.state, side, None, systematic=True, near=white.fit)
    best = with_drift(task, steady, tell)
    favour = nearer * float(np.log(_distance(lengths[side]) / _distance(lengths[other])))
    if favour > 0.0:  # beside a drift that nobody knew yet, the far side may have looked better
        best = task.on_the_other_side(best, tried[other].fit, favour)
    drift_evidence, systematic_evidence = steady.fit.objective - best.fit.objective, 0.0
    if options.systematic:
        systematic_evidence = white.fit.objective - steady.fit.objective
        if best is not steady and systematic_evidence > 0.0:  # drift may explain the same
            kind = None if best.model.drift is None else best.model.drift.walk
            without = task.settle(best.state, best.model.side, kind, systematic=False, near=best.fit)
            systematic_evidence = without.fit.objective - best.fit.objective
    white = tried[best.model.side]
    return replace(best, white=white, drift_evidence=drift_evidence, systematic_evidence=systematic_evidence)


def noise_in(
    task: Task,
    found: Settled,
    mixture: Mixture,
    constant: tuple[Array, Array],
    scatter: tuple[Scatter, ...],
    worst: Scatter | None,
    lasting: LastingErrors | None,
) -> NoiseInData:
    """What the data say of their noise; `constant` are the variances of `constant_variances`."""
    white = found.white or found
    middle, low, high = mixture.quantiles((0.5, 0.05, 0.95))
    active = found.fit.sizes.active
    stated = dict(zip((C.ROTATION, C.TRANSLATION), found.model.rows.typical_given, strict=True))
    simple = white.model.evaluate(white.fit.sizes.values(white.fit.logs)).covariance
    ratios = [0.0]
    for unknown, place in task.layout.slots.items():
        if unknown.kind is UnknownKind.FRAME and not task.layout.free[place].any():
            rows = found.model.basis[place]
            independent, real = (np.linalg.slogdet(rows @ C_all @ rows.T)[1] for C_all in (simple, mixture.covariance))
            ratios.append((independent - real) / 6.0)
    return NoiseInData(
        deviations={
            c: Deviation(*(stated.get(c, 1.0) * float(x) for x in of))
            for c, of in zip(active, zip(middle, low, high, strict=True), strict=True)
        },
        instants=task.instants.count,
        worth=task.instants.count * float(np.exp(min(ratios))),
        hand=found.model.side,
        correlation=None if found.model.drift is None else found.model.drift.walk.correlation,
        frame=None if found.model.drift is None else found.model.drift.walk.frame,
        drift_evidence=found.drift_evidence,
        systematic_evidence=found.systematic_evidence,
        drift_not_sought=why_no_drift(task),
        is_short=is_short(task),
        has_stamps=task.instants.seconds is not None,
        is_drift_doubted=is_drift_doubted(task, found),
        arms_assumed=C.SYSTEMATIC_ROTATION in active,
        systematic_probability=_probability(task, found),
        constant_deviations=tuple(tuple(np.sqrt(variances).tolist()) for variances in constant),
        scatter=scatter,
        worst=worst,
        lasting=lasting,
        jumps=len(task.jumps),
        farthest=found.model.evaluate(found.fit.sizes.values(found.fit.logs)).farthest,
    )


def mixed(task: Task, found: Settled, larger: float = 1.0) -> tuple[JointCovariance, Mixture, tuple[Array, Array]]:
    """The covariance, with the components' uncertainty mixed in, and the arm's constant error added; and its parts.

    It is ``larger`` where blocks of the log, or errors of the view, say so.
    """
    mixture = mixture_of(thinned(found.model), found.fit, found.model)
    basis = found.model.basis
    state = moved(found.state, task.variables, task.layout, basis @ mixture.step)
    constant = constant_variances(task, found, state, mixture)
    finite = basis @ mixture.covariance @ basis.T * larger
    for poses, variances in zip((state.X, state.Y), constant, strict=True):
        shift = _shifts(task, poses)
        finite += (shift * variances) @ shift.T
    return replace(task.layout, finite=finite), mixture, constant


def is_drift_doubted(task: Task, found: Settled) -> bool:
    """Whether errors of neighbours are alike, and tracks are too many for a model of that, or too short to trust one.

    In a short track a mount that slipped looks like drift, too.
    """
    is_few = task.instants.chains <= MOST_TRACKS
    if is_few and (task.options.drift == "none" or not is_short(task)):
        return False
    if found.model.drift is not None:
        return True
    eliminated = found.model.eliminated(found.fit.sizes.values(found.fit.logs))
    left = eliminated.left(eliminated.measured.of.columns)
    tracks = [left[task.instants.chain == chain] for chain in range(task.instants.chains)]
    return likeness_of_neighbours(tracks) > (CORRELATED if is_few else SURELY_CORRELATED)


def is_no_arm(task: Task) -> bool:
    """Whether the carriers' poses are farther apart than an arm reaches: then they come from a tracker.

    A tracker defines where the frames of what it tracks are. So what is constant is of a map that is bent, and smaller.
    """
    A = np.concatenate([item.residuals.A for item in task.data])
    ways = (A[:, :3, 3], se3.inverse(A)[:, :3, 3])  # of an arm in a far world, one of both is wide
    return min(float(np.linalg.norm(np.ptp(way, axis=0))) for way in ways) > FARTHEST_M


def constant_variances(task: Task, found: Settled, state: State, mixture: Mixture) -> tuple[Array, Array]:
    """Variances (6,) of constant errors of A: c of the hand, A Expmap(c), and of the base, Expmap(c) A.

    A Expmap(c) X = A X Expmap(Ad(X^-1) c), and Expmap(c) A X = Y B the same for Y: no residual shows c, since X or Y
    takes it up. It is tied to the part that varies with the configuration: `CONSTANT` times its deviations. (It is an
    assumption about arms: the first links' errors move with the base, the last links' with the hand.) Where the data
    hardly show the part that varies, it may not be there: the ellipsoid is that of the average over both models.
    """
    active = found.fit.sizes.active
    if C.SYSTEMATIC_ROTATION not in active:
        return np.zeros(6), np.zeros(6)
    share = CONSTANT_OF_TRACKER if is_no_arm(task) else CONSTANT
    places = [active.index(c) for c in (C.SYSTEMATIC_ROTATION, C.SYSTEMATIC_TRANSLATION)]
    deviations = share * np.repeat(np.exp(mixture.logs[:, places]), 3, axis=1)  # (samples, 6)
    probability = _probability(task, found)

    def of(poses: dict[str, gtsam.Pose3]) -> Array:
        shift, most = _shifts(task, poses), 0.0
        for name in poses:
            rows = task.layout.slots.get(Unknown(UnknownKind.FRAME, name))
            if rows is not None and shift[rows].any() and not task.layout.free[rows].any():
                roots = shift[rows] * deviations[:, None, :]
                most = mixture.share_of(found.model.basis[rows], roots, probability, most)
        variances: Array = most * (mixture.weights @ deviations**2)
        return variances

    return of(state.X), of(state.Y)


def _shifts(task: Task, poses: dict[str, gtsam.Pose3]) -> Array:
    """How a constant error of A moves the frames (d, 6) of one carrier."""
    shift = np.zeros((len(task.layout.unit), 6))
    for name, pose in poses.items():
        unknown = Unknown(UnknownKind.FRAME, name)
        if unknown in task.layout.slots and name not in task.problem.priors:  # a prior is of the true pose
            shift[task.layout.slots[unknown]] = pose.inverse().AdjointMap()
    return shift


def _probability(task: Task, found: Settled) -> float:
    """That errors which vary with the configuration are there, by the likelihoods' ratio."""
    is_stated = any(component in task.options.stated for component in SYSTEMATIC)
    return 1.0 if is_stated else float(expit(0.5 * found.systematic_evidence + LOG_ODDS))


def _distance(poses: dict[str, gtsam.Pose3]) -> float:
    """The typical distance of frames from their carrier, m; without frames, the smallest."""
    return max(float(np.median([float(np.linalg.norm(pose.translation())) for pose in poses.values()] or [0.0])), 1e-6)
