"""Outliers: which measurements agree, which were left out, and which frames the outliers contradict.

Where every measurement counts, a robust fit of a sample finds those that look wrong. Where the measurements that were
left out agree with one another far better than those that were kept (a planar target that is seen flipped), the choice
is reversed.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from gtsam_rwhec.calibration.calibrate_options import Inliers, Run, agreeing, offsets_of
from gtsam_rwhec.calibration.trial_fits import MEDIAN_OF_CHI, Sample, Sampled, TrialFit, fitted, implausible, residuals
from gtsam_rwhec.calibration.verdict import OUTLIERS, Choice, Ground
from gtsam_rwhec.errors import NoiseError, OutlierError, ScaleError
from gtsam_rwhec.fitting.refined import Refined
from gtsam_rwhec.fitting.refinement_from_poses import refine
from gtsam_rwhec.fitting.robust_solution import NoiseScale, robust_solution
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.geometry.trajectory import LONGEST_GAP_S
from gtsam_rwhec.problem.knowledge import scale_at
from gtsam_rwhec.problem.measurements import Pair
from gtsam_rwhec.problem.problem import Problem
from gtsam_rwhec.solver.solution import Solution, solve

#: "Half of its measurements".
HALF = 0.5
#: Outliers that agree with each other (a planar target's other pose) may be nearly half, and then win by chance.
NEARLY_HALF = 0.42
#: From so many measurements on, nearly half of them are not outliers by chance.
MANY_OF_A_FRAME = 10


@dataclass(frozen=True)
class LeftOut:
    """How many measurements of one sensor or target were left out as outliers; ``str()`` is a sentence's part."""

    frame: str
    left_out: int
    measurements: int

    def __str__(self) -> str:
        return f"{self.left_out} of {self.measurements} measurements of {self.frame} contradict the answer"

    def is_beyond(self, share: float) -> bool:
        """Whether more than this share of the measurements are outliers.

        Of few measurements, more than half must be outliers; if ``share`` is below a half, exactly half is enough,
        because chance decided which half was kept.
        """
        if self.measurements >= MANY_OF_A_FRAME:
            return self.left_out > share * self.measurements
        twice = 2 * self.left_out
        return twice > self.measurements or (share < HALF and twice == self.measurements > 0)


def contradicted_frames(counts: Mapping[Pair, tuple[int, int]]) -> tuple[LeftOut, ...]:
    """The sensors and targets with mostly outliers: more than half, half of few measurements, or nearly half of many.

    ``counts`` has the number that was kept and the number of all, by pair. Where most are outliers the answer is as
    likely to be wrong as they are: a clock, a size or a mounting may have changed. The frame with most outliers comes
    first. Its outliers then count for no other frame: the targets are not to blame for a camera that contradicts all of
    them. So frames with more than half come before those with nearly half: of two cameras that see one target, the
    one that contradicts everything makes half of the target's measurements outliers.
    """
    rest = counts
    everything = _by_frame(counts)
    names: list[str] = []
    for share in (HALF, NEARLY_HALF):
        while beyond := [frame for frame in _by_frame(rest).values() if frame.is_beyond(share)]:
            names.append(max(beyond, key=lambda frame: frame.left_out).frame)
            rest = {pair: count for pair, count in rest.items() if names[-1] not in pair}
    # A frame that has measurements only with contradicted frames depends on these.
    known = {*names, *_by_frame(rest)}
    names += [name for name, frame in everything.items() if name not in known and frame.is_beyond(NEARLY_HALF)]
    return tuple(everything[name] for name in names)


def _by_frame(counts: Mapping[Pair, tuple[int, int]]) -> dict[str, LeftOut]:
    """The counts of each sensor and target, over all its pairs."""
    left_out, measurements = Counter[str](), Counter[str]()
    for pair, (kept, number) in counts.items():
        for name in pair.frames:
            left_out[name] += number - kept
            measurements[name] += number
    return {name: LeftOut(name, left_out[name], number) for name, number in measurements.items()}


#: A sentence about outliers names at most this many pairs.
NAMED = 5
#: With fewer measurements of a frame, a wrong one cannot be recognized.
FEWEST_OF_A_FRAME = 3


@dataclass(frozen=True)
class Outliers:
    """The measurements that were left out because they contradict the others."""

    #: The measurements that were kept, in the order of ``problem.measurements``; empty if none were looked for.
    inliers: dict[Pair, np.ndarray]
    counts: dict[Pair, tuple[int, int]]  #: The number kept, and the number of all
    left_out: tuple[str, ...]  #: Sensors and targets that have no measurement left, and so no pose
    looked_for: bool  #: Whether outliers were looked for

    @staticmethod
    def of(problem: Problem, inliers: dict[Pair, np.ndarray]) -> Outliers:
        """The outliers of a problem; without ``inliers`` they were not looked for, and every measurement counts."""
        totals = {pair: problem.moments(*pair).count for pair in problem.pairs}
        counts = {pair: (int(inliers[pair].sum()) if inliers else total, total) for pair, total in totals.items()}
        left = {name for pair, (kept, _) in counts.items() if kept for name in pair}
        left_out = tuple(name for name in (*problem.sensors, *problem.targets) if name not in left)
        return Outliers(inliers, counts, left_out, looked_for=bool(inliers))

    @property
    def resting_on_few(self) -> dict[str, int]:
        """The sensors and targets with fewer than three measurements in all, and how many they have."""
        kept = Counter[str]()
        for pair, (number, _) in self.counts.items():
            for name in pair.frames:
                kept[name] += number
        return {name: number for name, number in kept.items() if 0 < number < FEWEST_OF_A_FRAME}

    @property
    def number(self) -> int:
        """How many measurements were left out."""
        return sum(total - kept for kept, total in self.counts.values())

    def __str__(self) -> str:
        total = sum(number for _, number in self.counts.values())
        if not self.looked_for:
            return f"Outliers were not looked for among {total} measurements."
        if not self.number:
            return f"No outliers among {total} measurements."
        return f"{self.number} of {total} measurements contradict the others and were left out: {self.by_pair}."

    @property
    def by_pair(self) -> str:
        """How many measurements of each pair were left out, as words; the largest number first."""
        out = {pair: (number - kept, number) for pair, (kept, number) in self.counts.items() if kept < number}
        most = sorted(out.items(), key=lambda item: -item[1][0])[:NAMED]
        named = [f"{number} of {of} of {pair}" for pair, (number, of) in most]
        more = f", and some of {len(out) - NAMED} other pairs" if len(out) > NAMED else ""
        return f"{', '.join(named)}{more}"

    def choice(self, evidence: str) -> Choice:
        """The choice of inliers for the record; ``evidence`` is why some measurements were left out."""
        if not self.number:
            return Choice(OUTLIERS, "none", "every measurement agrees with the others")
        total = sum(number for _, number in self.counts.values())
        return Choice(OUTLIERS, f"{self.number} of {total} measurements were left out ({self.by_pair})", evidence)


def few_words(frame: str, number: int) -> str:
    """The words for a frame with so few measurements."""
    rest = ": a wrong one would not show" if number == 1 else "s: a wrong one could not be told from the other"
    return f"{frame} rests on {number} measurement{rest}"


#: An error of this many medians is gross. No Gaussian error is; of Student's t errors, one in 4,000 with 5 degrees of
#: freedom, and one in 300 with 3.
GROSS = 8.0
#: A pair with fewer rows has no median of its own; that of all pairs counts.
FEWEST_ROWS_OF_MEDIAN = 10
#: At most this many pairs, and this many measurements, are tested.
MOST_PAIRS_ASKED, MOST_ASKED = 200, 10_000
#: With fewer measurements in all, a wrong one cannot be told from the others.
FEWEST_ASKED = 8


def gross_errors(problem: Problem) -> str:
    """How many measurements look wrong, as a sentence's part; empty where none does, or none can be told.

    Of a large problem only a sample is tested, without pairs with few measurements.
    """
    sampled = Sampled.of(problem, MOST_PAIRS_ASKED, MOST_ASKED)
    if sampled is None or sampled.count < FEWEST_ASKED:
        return ""
    fit = fitted(problem, sampled.as_read())
    if fit is None:  # a sample without an answer tells nothing; how large the residuals of all are is judged
        return ""
    ends = np.cumsum([len(rows) for rows in sampled.rows.values()])[:-1]
    errors = fit.errors / _stated(sampled)
    medians = np.median(errors, axis=1, keepdims=True)
    number = 0
    for of_pair in np.split(errors, ends, axis=1):  # the larger of both errors, in medians of the pair, or of all
        few = of_pair.shape[1] < FEWEST_ROWS_OF_MEDIAN
        own = medians if few else np.maximum(medians, np.median(of_pair, axis=1, keepdims=True))
        number += int(((of_pair / np.maximum(own, 1e-12)).max(axis=0) > GROSS).sum())
    if not number:
        return ""
    rest = problem.number_of_measurements - sampled.count
    others = f"; {rest} more {'was' if rest == 1 else 'were'} not looked at" if rest else ""
    return (
        f"{number} of {sampled.count} measurements {'looks' if number == 1 else 'look'} wrong (off by more than "
        f"{GROSS:g} times what half of the others are off by{others}), and still every measurement counts"
    )


def _stated(sampled: Sampled) -> Array:
    """The noise that was stated for each measurement (2, N), rad and m: only its ratios count."""
    rows = [(sampled.whole[pair], chosen) for pair, chosen in sampled.rows.items()]
    rotation = np.concatenate([np.sqrt(0.5 / raw.kappa[chosen]) for raw, chosen in rows])
    return np.stack([rotation, np.concatenate([raw.sigma[chosen] for raw, chosen in rows])])


#: Measurements that were left out are tested if they are at least this share of all, and at least this many.
SHARE_LEFT_OUT, FEWEST_LEFT_OUT = 0.25, 8
#: The medians of its residuals, rotation times translation, are this many times smaller than those of what was kept.
FAR_SMALLER = 25.0
#: A measurement agrees with a fit within this many standard deviations, of rotation and of translation.
AGREES_SIGMAS = 5.0


def more_consistent(problem: Problem, inliers: Inliers) -> Inliers | None:
    """The measurements that agree with those that were left out, where these agree far better with one another.

    None where the choice of ``inliers``, by pair (N,) booleans, stands.
    """
    number = sum(len(mask) for mask in inliers.values())
    left_out = sum(int((~mask).sum()) for mask in inliers.values())
    if left_out < max(FEWEST_LEFT_OUT, SHARE_LEFT_OUT * number):
        return None
    raw = {pair: problem.measurements(*pair) for pair in inliers}
    kept: Sample = {pair: (raw[pair].A[mask], raw[pair].B[mask]) for pair, mask in inliers.items() if mask.any()}
    other: Sample = {pair: (raw[pair].A[~mask], raw[pair].B[~mask]) for pair, mask in inliers.items() if not mask.all()}
    of_kept, of_other = fitted(problem, kept), fitted(problem, other)
    if of_kept is None or of_other is None or _product(of_other) * FAR_SMALLER > _product(of_kept):
        return None
    if not all(name in of_other.frames for pair in inliers for name in pair.frames):
        return None  # it does not tell all frames
    spread = np.array([of_other.residual.rotation_rad, of_other.residual.translation_m]) / MEDIAN_OF_CHI
    found: Inliers = {}
    for pair in inliers:
        scale = scale_at(of_other.scale, pair.target)
        errors = residuals(of_other.frames, scale, pair, raw[pair].A, raw[pair].B)
        found[pair] = np.asarray((errors < AGREES_SIGMAS * spread[:, None]).all(axis=0))
    return found if sum(int(mask.sum()) for mask in found.values()) >= left_out // 2 else None


def _product(fit: TrialFit) -> float:
    return fit.residual.rotation_rad * fit.residual.translation_m


#: Outliers are looked for only with so many more equations than unknowns: six belong to a wrong measurement, and the
#: rest must show the noise.
SPARE_EQUATIONS = 24
#: If the noise is about right, more than this share of the measurements agree.
MOST_AGREE = 0.5
#: From this share of outliers on, the verdict reports them.
MANY = 0.3
#: From this share on, of a stream with at least so many stamps: where so much is wrong, what is kept is in doubt too.
MANY_OF_A_STREAM, LEAST_OF_A_STREAM = 0.15, 40
#: With fewer measurements than `FEW`, a share of outliers above `MANY_OF_FEW` may mean that the stated noise is too
#: small. It is, if the noise that the residuals show leaves no outlier.
FEW, MANY_OF_FEW = 20, 0.25
#: If at least this share agrees, with residuals that a sensor may have, the others are outliers.
MAJORITY = 0.6


def without_outliers(
    run: Run, first: Solution | None, clearly_off: tuple[str, ...] = ()
) -> tuple[Solution | None, Inliers]:
    """The certified solution of the measurements that agree, and which these are: empty if all count.

    Parameters
    ----------
    run : Run
    first : Solution or None
        The certified solution of all measurements; None where it has no positive scale.
    clearly_off : tuple of str
        Sensors whose clocks are clearly off. Their offsets are estimated here too, since a late clock makes outliers.
    """
    problem, options, record = run.problem, run.options, run.record
    lacking = -((spare_equations(problem) - SPARE_EQUATIONS) // 6)
    why = ""
    if options.robust == "none":
        why = run.says_so
        if gross := gross_errors(problem):
            record.find(Ground.OUTLIERS_KEPT, gross)
    elif not problem.has_measurements:
        why = "the raw measurements were not kept"
    if not problem.has_measurements:
        lost = "outliers, mistakes of reading, late clocks, wrong sizes, noise of A and drift"
        record.find(Ground.NOT_CHECKED, f"the raw measurements were not kept, so {lost} were not looked for")
    if why:
        record.choose(OUTLIERS, "every measurement counts", why)
        return first, {}
    # Where something slides, a few measurements determine the answer exactly, and all others would look wrong.
    slides = problem.number_of_equations < 6 * problem.number_of_measurements
    if lacking > 0 and (options.robust == "auto" or slides):
        why = f"{problem.number_of_measurements} measurements are too few to tell a wrong one from the others"
        record.choose(OUTLIERS, "not looked for", f"{why}; {lacking} more would do")
        # No finding: what is wrong shows against a stated noise; where none is stated, the verdict asks for care.
        return first, {}
    offsets = clearly_off or offsets_of(problem, options)
    try:
        solution, inliers = run.agreed or _agreeing(run, first, offsets)
        other = more_consistent(problem, inliers)
        if other is not None:
            return solve(agreeing(problem, other), options=options.solve), other
        return solution, inliers
    except (OutlierError, NoiseError, ScaleError) as error:
        record.choose(OUTLIERS, "not left out", f"it is not possible: {error}")
        record.find(Ground.CONTRADICTED, "too few measurements agree with one another to find out which are wrong")
        return first, {}


def _agreeing(run: Run, first: Solution | None, offsets: bool | tuple[str, ...]) -> tuple[Solution, Inliers]:
    """The certified solution of the measurements that agree, and which these are.

    Under a stated noise that is far too small nearly nothing agrees. Where most agree under the noise that the
    residuals show, that noise decides; the stage of the noise says then that the stated one is too small.
    """
    if run.options.noise != "given":
        return _agreeing_under(run, first, offsets, "estimate")
    try:
        found = _agreeing_under(run, first, offsets, "given")
        share = _share_kept(found[1])
        is_doubtful = run.problem.number_of_measurements < FEW and share < 1.0 - MANY_OF_FEW
        if share > MOST_AGREE and not is_doubtful:
            return found
    except (OutlierError, NoiseError, ScaleError) as error:
        found, share, why = None, 0.0, error
    try:
        other = _agreeing_under(run, first, offsets, "estimate")
    except (OutlierError, NoiseError, ScaleError):
        other = None
    if other is not None and (_share_kept(other[1]) == 1.0 or (_share_kept(other[1]) > MOST_AGREE >= share)):
        return other
    if found is None:
        raise why
    return found


def _share_kept(inliers: Inliers) -> float:
    return float(np.concatenate(list(inliers.values())).mean())


def _agreeing_under(
    run: Run, first: Solution | None, offsets: bool | tuple[str, ...], noise: NoiseScale
) -> tuple[Solution, Inliers]:
    problem, options = run.problem, run.options
    has_more = problem.has_covariances or options.carrier_noise is not None or bool(offsets)
    if first is not None and has_more:
        refined = refined_with_outliers(run, first, offsets, noise)
        return refined.solution, refined.inliers
    found = robust_solution(problem, confidence=options.inlier_confidence, noise_scale=noise, progress=run.tell)
    return found.solution, found.inliers


def refined_with_outliers(
    run: Run, first: Solution | None, offsets: bool | tuple[str, ...], noise: NoiseScale
) -> Refined:
    """The refinement with inliers chosen again by ``refine``, under noise that sigma and kappa cannot express."""
    how = run.options.refinement(offsets, noise=noise, robust="gnc", carrier_model="propagated")
    try:
        return refine(run.problem, first, how, progress=run.tell)
    except NoiseError:
        if how.carrier_noise is None:
            raise
        # The noise stated for A is larger than the residuals show. Inliers are judged by the residuals' own noise, and
        # again under the noise that is found.
        return refine(run.problem, first, replace(how, carrier_noise=None), progress=run.tell)


def share_that_agrees_plausibly(run: Run, first: Solution | None) -> float | None:
    """The share of the measurements that agree with one another, with residuals that a sensor may have.

    None where fewer than ``MAJORITY`` do: then outliers do not explain what is wrong with the others.
    """
    attempt = run.attempt()
    solution, inliers = without_outliers(attempt, first)
    if solution is None or not inliers or _share_kept(inliers) < MAJORITY:
        return None
    return None if implausible(agreeing(run.problem, inliers), solution) else _share_kept(inliers)


def say_outliers(run: Run, inliers: Inliers) -> None:
    """The choice of outliers, where they were looked for."""
    if inliers:
        outliers = Outliers.of(run.problem, inliers)
        run.record.choices.append(outliers.choice("they are farther off than the noise of the others explains"))


def outliers_of(run: Run, inliers: Inliers, *, is_answered: bool) -> Outliers:
    """The outliers; findings are recorded for frames that they contradict or leave with too few measurements."""
    outliers = Outliers.of(run.problem, inliers)
    sensors = run.problem.sensors
    contradicted = contradicted_frames(outliers.counts)
    for frame in contradicted:
        run.record.find(Ground.CONTRADICTED if frame.frame in sensors else Ground.TARGET_CONTRADICTED, str(frame))
    for name in outliers.left_out:
        if name in sensors:
            words = f"{name} has no pose, because no measurement of it is in the answer"
            run.record.find(Ground.NO_ANSWER, words)
    number = sum(len(mask) for mask in inliers.values())
    left_out = sum(int((~mask).sum()) for mask in inliers.values())
    if left_out > (MANY_OF_A_STREAM if is_stream(run.problem) else MANY) * number and not contradicted:
        words = f"{left_out} of {number} measurements contradict the answer and were left out"
        run.record.find(Ground.MANY_OUTLIERS, words)
    if is_answered:
        known = {frame.frame for frame in contradicted} | {*run.problem.fixed, *run.problem.priors}
        for name, number in outliers.resting_on_few.items():
            if name not in known:
                run.record.find(Ground.FEW_MEASUREMENTS, few_words(name, number))
    return outliers


def is_stream(problem: Problem) -> bool:
    """Whether measurements follow one another on a clock, as a moving camera's do, and not from station to station."""
    raw = [problem.measurements(*pair) for pair in problem.pairs] if problem.has_measurements else []
    known = [one.stamps_ns for one in raw if one.stamps_ns is not None]
    if not known or len(known) < len(raw):
        return False
    stamps_ns = np.unique(np.concatenate(known))
    return len(stamps_ns) >= LEAST_OF_A_STREAM and float(np.median(np.diff(stamps_ns))) <= 1e9 * LONGEST_GAP_S


def spare_equations(problem: Problem) -> int:
    """How many more equations than unknowns there are: six for each measurement, and those of priors."""
    free = [name for name in (*problem.targets, *problem.sensors) if name not in problem.fixed]
    beliefs = [prior for name in free for prior in problem.priors.get(name, [])]
    scales = {"known": 0, "shared": 1}.get(problem.scale)
    if scales is None:
        scales = len({pair.target for pair in problem.pairs} - set(problem.fixed_scales))
    known = sum(3 * (prior.sigma is not None) + 3 * (prior.kappa is not None) for prior in beliefs)
    return problem.number_of_equations + known - 6 * len(free) - scales
