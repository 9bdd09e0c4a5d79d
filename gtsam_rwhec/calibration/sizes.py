"""Tests of the sizes of targets that were stated as known, and of lengths that no rig has.

Sizes are estimated with everything else, and compared with 1. Standard deviations of a refinement are too small
where errors of neighbouring measurements are alike, or depend on the arm's pose. So, where one would doubt a size, it
is estimated again under the whole model of the noise; where there is none, blocks of rows are left out in turn
(jackknife), and the larger standard deviation counts.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.special import expit

from gtsam_rwhec.errors import CountError, NoiseError, RwhecWarning, ScaleError, UnderdeterminedError
from gtsam_rwhec.files.progress import Progress, check_progress, silent
from gtsam_rwhec.files.terminal_text import rounded
from gtsam_rwhec.fitting.fit_options import NoiseOptions, RefineOptions, Walk
from gtsam_rwhec.fitting.noise_in_data import NoiseInData
from gtsam_rwhec.fitting.noise_refinement import refine_under_noise
from gtsam_rwhec.fitting.refined import Refined, sigma_of
from gtsam_rwhec.fitting.refinement_from_poses import refine
from gtsam_rwhec.fitting.unknowns import Unknown, UnknownKind
from gtsam_rwhec.geometry.blas_threads import one_blas_thread
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.geometry.real_numbers import check_kind
from gtsam_rwhec.problem.knowledge import ScaleMode, scale_at
from gtsam_rwhec.problem.problem import Problem
from gtsam_rwhec.problem.selection import selected, summed_again
from gtsam_rwhec.solver.solution import Solution, solve

#: Standard deviations by which a stated size must differ from the measured size before it is doubted.
SIZE_SIGMAS = 5.0
#: From so many on, the size is uncertain: the poses are to be used with care.
UNCERTAIN_SIGMAS = 3.5
#: From so many on, a size counts as evidence for a factor that all sizes share.
SPEAKING_SIGMAS = 2.0
#: A size is doubted only if it also differs by this share: printers, calipers and intrinsics are seldom more exact.
SIZE_SHARE = 0.004
#: Smaller shares move nobody's poses. Lengths in clouds are uncertain from it on, since nobody states them: 0.3 % was
#: 1.1 mm with 0.04 mm claimed.
LEAST_SHARE = 0.0005
#: A size that is wrong by more than this factor is not determined by the motion.
LARGEST = 1e4
#: So many blocks of each pair's rows are left out in turn.
BLOCKS = 10
#: With so few blocks, the standard deviation itself is uncertain: the ratio of Student's and Gauss's quantiles at the
#: five standard deviations of the test, for nine degrees of freedom.
STUDENT = 2.6
#: The same at two deviations.
USUAL_STUDENT = 1.15
#: Printers and focal lengths are off by such a share, usually.
PRINTED = 0.002
#: Such an error must not move a sensor out of its ellipsoid of 95 %: the quantile of chi2(6).
OUTSIDE = 12.59
#: Standard deviations of the priors that stand for fixed poses here, in metres and rad.
FIXED_M, FIXED_RAD = 1e-4, 1e-4


def is_size_doubted(scale: float, sigma: float | None) -> bool:
    """Whether measurements contradict a stated size clearly, and by a share that matters.

    ``scale`` is the stated over the true length; ``sigma`` its standard deviation, None where it is not determined.
    """
    return _is_off(scale, sigma, SIZE_SIGMAS, SIZE_SHARE)


def is_size_uncertain(scale: float, sigma: float | None) -> bool:
    """Whether measurements speak against a stated size, though not clearly."""
    return _is_off(scale, sigma, UNCERTAIN_SIGMAS, SIZE_SHARE) and not is_size_doubted(scale, sigma)


def _is_off(scale: float, sigma: float | None, sigmas: float, share: float) -> bool:
    off = abs(scale - 1.0)
    return sigma is not None and off > share and off > sigmas * sigma


@dataclass(frozen=True)
class TargetSize:
    """What the motion says about the size of a target that was taken as known; ``str()`` is one sentence."""

    target: str  #: The target; or a sensor, for the lengths of its own motions
    scale: float  #: Lengths in B over true lengths: the stated over the true size
    sigma: float | None  #: Standard deviation of the scale; None where the motion does not determine it
    #: Whether no test of it could run: it looked wrong and hangs on single blocks of rows, or no answer has it
    is_untested: bool = False
    #: Whether it has no stated size, but lengths in clouds
    is_of_clouds: bool = False
    #: Standard deviation at the usual two deviations, where ``sigma`` has the caution of a test at five; None: as that
    usual_sigma: float | None = None
    #: (6, 1) by frame: how its pose moves (right perturbation) with the scale
    moves: Mapping[str, Array] = field(default_factory=dict, hash=False, compare=False, repr=False)

    @property
    def is_doubted(self) -> bool:
        """Whether the measurements contradict the stated size clearly, and by a share that matters."""
        return is_size_doubted(self.scale, self.sigma)

    @property
    def is_uncertain(self) -> bool:
        """Whether the measurements speak against the stated size, though not clearly."""
        share = LEAST_SHARE if self.is_of_clouds else SIZE_SHARE
        return _is_off(self.scale, self.sigma, UNCERTAIN_SIGMAS, share) and not self.is_doubted

    @property
    def may_be_off(self) -> bool:
        """Whether it may be wrong by a share that few would measure: then the poses are known less well."""
        return _is_off(self.scale, self._usual, SPEAKING_SIGMAS, LEAST_SHARE)

    @property
    def share_off(self) -> float:
        """By which share it may be wrong (root mean square); 0 where no scale is determined.

        Either it is exact, or off as printers err; both are as likely beforehand, and the motion weighs them (Bayes).
        """
        sigma = self._usual
        if sigma is None or sigma <= 0.0:
            return 0.0
        off, shrunk = self.scale - 1.0, 1.0 / (1.0 + (sigma / PRINTED) ** 2)
        is_off = expit(math.log(sigma / math.hypot(PRINTED, sigma)) + 0.5 * (off / sigma) ** 2 * shrunk)
        return float(np.sqrt(is_off * ((shrunk * off) ** 2 + shrunk * sigma**2)))

    @property
    def _usual(self) -> float | None:
        return self.sigma if self.usual_sigma is None else self.usual_sigma

    def untold(self, refined: Refined) -> str:
        """What a usual error, which the motion would not show, moves a sensor by, in words; empty where that is little.

        That is, where the sensor stays in its ellipsoid of 95 %, or the motion tells the size.
        """
        sigma = self._usual
        if sigma is None or sigma < 0.5 * PRINTED or self.may_be_off:
            return ""
        moved = {name: PRINTED * move[:, 0] for name, move in self.moves.items() if name in refined.Y}
        outside = [name for name, m in moved.items() if m @ refined.information(name) @ m > OUTSIDE]
        if not outside:
            return ""
        moved_mm, most = max((1e3 * float(np.linalg.norm(moved[name][3:])), name) for name in outside)
        of, who = ("lengths in the clouds", "cameras") if self.is_of_clouds else ("the size", "printers")
        return (
            f"the motion tells {of} of {self.target} to {rounded(100.0 * sigma)} % only, and {100.0 * PRINTED:g} %, as "
            f"{who} err, moves {most} by {rounded(moved_mm)} mm, which the standard deviations do not hold"
        )

    def __str__(self) -> str:
        if self.sigma is None:
            return f"the motion does not tell the size of {self.target}"
        if self.is_of_clouds:
            return (
                f"lengths in the clouds of {self.target} are {_off(self.scale)} than the motion says (standard "
                f"deviation {rounded(100.0 * self.sigma)} %): those of the clouds are wrong, or those of the poses (of "
                "the robot, or of a camera by a printed size)"
            )
        return (
            f"the stated size of {self.target} is {_off(self.scale)} than the motion says "
            f"(standard deviation {rounded(100.0 * self.sigma)} %)"
        )


def common_factor(found: Sequence[TargetSize]) -> str:
    """A sentence about the factor by which all sizes are wrong; empty if they are right, or factors differ."""
    told = [(size.scale, size.sigma) for size in found if size.sigma is not None]
    if len(told) < 2:
        return ""
    scales, sigmas = np.array(told).T
    weights = 1.0 / np.maximum(sigmas, 1e-9) ** 2
    scale, sigma = float(weights @ scales / weights.sum()), float(sigmas.min())  # their errors may be alike
    alike = np.abs(scales - scale) <= np.maximum(UNCERTAIN_SIGMAS * sigmas, SIZE_SHARE)
    speaks = (scales - 1.0) * np.sign(scale - 1.0) > SPEAKING_SIGMAS * sigmas
    if not alike.all() or speaks.sum() < 2 or not is_size_doubted(scale, sigma):
        return ""
    return (
        f"the stated sizes of all {len(told)} targets are {_off(scale)} than the motion says (standard deviation "
        f"{rounded(100.0 * sigma)} %), by one factor: the unit of lengths in A, or the focal length, may be wrong as "
        "well (the motion gives this factor with scale='shared' or --scale shared)"
    )


def _off(scale: float) -> str:
    percent = 100.0 * (scale - 1.0)
    return f"{rounded(abs(percent))} % {'larger' if percent > 0.0 else 'smaller'}"


@one_blas_thread()
def sizes(
    problem: Problem,
    options: RefineOptions | None = None,
    *,
    like: NoiseInData | None = None,
    progress: Progress | None = None,
) -> tuple[TargetSize, ...]:
    """Estimate the sizes of all targets of a problem whose scale is said to be known.

    Parameters
    ----------
    problem : Problem
        With scale="known" and its raw measurements, without outliers.
    options : RefineOptions, optional
        How the noise is taken; by default it is estimated from the residuals.
    like : NoiseInData, optional
        Noise found with the sizes as stated: the carrier that errors of A are about, and the drift, are kept from it.
    progress : callable, optional

    Returns
    -------
    tuple of TargetSize
        One for each target; ``is_untested`` where the measurements are too few. Empty where the scale is not said to be
        known, the measurements were not kept, or no positive sizes fit: then the motion says nothing about them.
    """
    check_progress(progress)
    check_kind(problem, Problem, "the problem", "a gtsam_rwhec.Problem")
    if problem.scale != "known" or not problem.has_measurements or not problem.pairs:
        return ()
    (progress or silent)("looking at the targets' sizes")
    free = summed_again(problem)
    free.scale = free_scale(problem)
    free.fixed, free.priors = dict(problem.fixed), dict(problem.priors)
    # Tight priors in place of fixed poses of what has a size: the certified form cannot hold both as they are, unless
    # measurements weigh by direction.
    for name in {pair.target for pair in free.pairs if not free.directed} & set(free.fixed):
        T = free.fixed.pop(name)
        free.priors.pop(name, None)
        free.add_prior(name, T, FIXED_M, 0.5 / FIXED_RAD**2)
    with warnings.catch_warnings(action="ignore", category=RwhecWarning):  # they are about sizes that nobody uses
        try:
            start = solve(free)
            scales = start.scale.values() if isinstance(start.scale, dict) else [start.scale]
            if not all(1.0 / LARGEST < scale < LARGEST for scale in scales):
                return ()  # the lengths of B tell nothing, or they are those of another unit: that is a misreading
            refined = refined_by(free, start, options or RefineOptions(noise="estimate"))
        except ScaleError:
            return ()  # as where the motion leaves sizes free: by chance they are then positive or not
        except (CountError, NoiseError, UnderdeterminedError):
            return tuple(
                TargetSize(name, 1.0, None, is_untested=True) for name in {pair.target: 0 for pair in free.pairs}
            )
        found = _marked(sizes_in(refined), problem)
        if any(size.is_doubted or size.is_uncertain or size.may_be_off for size in found):
            found = _under_all_noise(free, start, options, like, progress or silent) or _with_jackknife(free, found)
    return tuple(_marked(found, problem))


def free_scale(problem: Problem) -> ScaleMode:
    """How sizes of a problem are estimated: what weighs by direction has one factor for all."""
    return "shared" if problem.directed else "per_target"


def _marked(found: Sequence[TargetSize], problem: Problem) -> list[TargetSize]:
    of_clouds = {pair.target for pair in (*problem.alike, *problem.directed)}
    return [replace(size, is_of_clouds=size.target in of_clouds) for size in found]


def refined_by(
    problem: Problem,
    start: Solution | None,
    options: RefineOptions,
    progress: Progress | None = None,
    near: Refined | None = None,
) -> Refined:
    """The refinement by these options; without the noise that was stated for A where the residuals hold no such."""
    try:
        return refine(problem, start, options, progress=progress, near=near)
    except NoiseError:
        if options.carrier_noise is None:
            raise
        return refine(problem, start, replace(options, carrier_noise=None), progress=progress)


def _under_all_noise(
    free: Problem, start: Solution, options: RefineOptions | None, like: NoiseInData | None, progress: Progress
) -> list[TargetSize]:
    """The sizes under the noise that the data have; none where that cannot be modelled, or is given."""
    if options is not None and (options.noise != "estimate" or options.carrier_noise is not None):
        return []
    kinds = NoiseOptions()
    if like is not None:
        if like.is_drift_doubted:
            return []
        walk = None if like.correlation is None or like.frame is None else Walk(like.correlation, like.frame)
        kinds = NoiseOptions(drift=walk or "none", side=like.hand, systematic=like.arms_assumed)
    try:
        refined, noise = refine_under_noise(free, start, options, kinds, progress=progress)
    except (CountError, ScaleError, np.linalg.LinAlgError, RuntimeError):
        return []  # harmless: the jackknife tests the sizes
    # where drift is untried, errors of neighbours in time are alike, and the deviations do not know it
    return [] if noise.is_drift_doubted else sizes_in(refined)


def sizes_in(refined: Refined) -> list[TargetSize]:
    """The sizes of an answer with a scale of each target, or one of all."""
    if not isinstance(refined.scale, Mapping):
        sigma = sigma_of(refined, "scale")
        moves = _moves(refined, Unknown.of("scale"))
        return [TargetSize(name, refined.scale, sigma, moves=moves) for name in refined.X]
    unknowns = {name: Unknown(UnknownKind.SCALE, name) for name in refined.scale}
    return [
        TargetSize(name, scale, sigma_of(refined, unknowns[name]), moves=_moves(refined, unknowns[name]))
        for name, scale in refined.scale.items()
    ]


def moves_of_sizes(found: Sequence[TargetSize]) -> list[dict[str, Array]]:
    """How frames are off (6, 1) by sizes that may be off by a share that is not doubted: printers are no more exact."""
    off = [size for size in found if size.share_off and not size.is_doubted]
    several = {id(size.moves): size for size in off}  # targets that share a scale have one error
    return [{name: one.share_off * move for name, move in one.moves.items()} for one in several.values()]


def _moves(refined: Refined, scale: Unknown) -> dict[str, Array]:
    """How the pose of each frame moves with a scale that is one of the unknowns: Cov(x, s) / Var(s)."""
    joint = refined.joint
    if scale not in joint.slots:
        return {}
    with_scale = joint.finite[:, joint.slots[scale]][:, 0]
    variance = float(with_scale[joint.slots[scale]][0])
    frames = [unknown for unknown in joint.slots if unknown.kind is UnknownKind.FRAME]
    return {str(frame): with_scale[joint.slots[frame], None] / variance for frame in frames} if variance > 0.0 else {}


def _with_jackknife(free: Problem, found: list[TargetSize]) -> list[TargetSize]:
    """The sizes with the larger standard deviation of theirs and of leaving out a block of each pair at a time.

    None where either is not determined.
    """
    counts = {pair: free.moments(*pair).count for pair in free.pairs}
    numbers = {pair: np.arange(count) * BLOCKS // count for pair, count in counts.items()}
    scales: dict[str, list[float]] = {size.target: [] for size in found}
    for block in range(BLOCKS):
        try:
            scale = solve(selected(free, {pair: of != block for pair, of in numbers.items()})).scale
        except (ScaleError, CountError, UnderdeterminedError):
            return [  # the sizes hang on single blocks
                replace(size, sigma=None, is_untested=size.is_doubted or size.is_uncertain) for size in found
            ]
        of_block = scale if isinstance(scale, dict) else dict.fromkeys(scales, scale)
        for name in scales.keys() & of_block.keys():
            scales[name].append(of_block[name])
    sigmas = {
        name: STUDENT * math.sqrt((BLOCKS - 1) * float(np.var(of))) for name, of in scales.items() if len(of) == BLOCKS
    }
    known = [size.sigma is not None and size.target in sigmas for size in found]
    return [
        replace(
            size,
            sigma=max(size.sigma or 0.0, sigmas[size.target]),
            usual_sigma=max(size.sigma or 0.0, sigmas[size.target] * USUAL_STUDENT / STUDENT),
        )
        if is_known
        else replace(size, sigma=None, is_untested=size.is_doubted or size.is_uncertain)
        for size, is_known in zip(found, known, strict=True)
    ]


#: No target is seen from farther away (m).
FAR_M = 100.0
#: No frame is mounted so far from its carrier (m) on both sides at once; one side may be a map with a distant origin.
LONG_ARM_M = 50.0


def doubted_lengths(problem: Problem, solution: Solution) -> str:
    """A sentence about lengths that no rig has: a target 800 m from a camera, a hand-eye lever arm of 300 m.

    Residuals do not show the unit that A and B share. Empty where all lengths are those of a rig; distances of targets
    need the raw measurements.
    """
    distances = [
        np.linalg.norm(batch.B[:, :3, 3], axis=1) / scale_at(solution.scale, pair.target)
        for pair in problem.pairs
        if not pair.is_motion
        for batch in problem.batches(*pair)
    ]
    distance_m = float(np.median(np.concatenate(distances))) if distances else np.nan
    # How far frames are from their carriers, as a median of the side where they are closer, if it is determined.
    arms_m = [
        float(np.median([np.linalg.norm(T.translation()) for T in frames.values()]))
        for frames in (solution.X, solution.Y)
        if frames and solution.identifiability.is_unique
    ]
    arm_m = min(arms_m, default=np.nan)
    found = [f"targets are seen from {rounded(distance_m, 4)} m"] if distance_m > FAR_M else []
    if arm_m > LONG_ARM_M:
        found.append(f"targets and sensors are {rounded(arm_m, 4)} m from their carriers")
    if not found:
        return ""
    return (
        f"{' and '.join(found)}: this looks like millimetres in A and B, which no residual shows; give metres: divide "
        "both by 1000"
    )


def undetectable(problem: Problem, *, unit_is_told: bool = False) -> tuple[str, ...]:
    """The mistakes in reading A and B that would change no residual of this problem, one sentence each.

    ``unit_is_told``: lengths that no rig has showed the unit.
    """
    unit = "A and B" if problem.scale == "known" else "A"
    found = [
        f"{unit} in another unit than metres: every length of the answer would be in that unit",
        "A and B both from left-handed frames: the answer would be left-handed too",
    ][unit_is_told:]
    pairs = [pair for pair in problem.pairs if not pair.is_motion]
    names = [name for pair in pairs for name in pair]
    if pairs and len(set(names)) == len(names):  # no frame is in two pairs
        found.append(
            "A and B both inverted, or targets and sensors exchanged: X would be the pose of the sensor, and Y that of "
            "the target"
        )
    return tuple(f"data cannot tell: {each}" for each in found)
