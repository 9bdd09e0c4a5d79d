"""The answer from corners: which model predicts images best that were left out, what comes out, and the poses again.

Poses of boards come first: they give the certified start, the outliers among images, and the noise in time and over the
configuration. The corners then give the answer, with the cameras' intrinsics as variables. Poses were computed by the
stated intrinsics, and a flat board's was chosen of two: where the answer says otherwise, they are computed again.
"""

from __future__ import annotations

import warnings
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from gtsam_rwhec.calibration.calibrate_options import CalibrateOptions, Inliers, Run
from gtsam_rwhec.calibration.clock_offsets import Answer
from gtsam_rwhec.calibration.verdict import Choice, Finding, Ground
from gtsam_rwhec.cameras.camera import Camera
from gtsam_rwhec.cameras.unknown_intrinsics import CORNERS, Lens, estimated_intrinsics
from gtsam_rwhec.errors import (
    CameraError,
    CountError,
    OptionError,
    OutlierError,
    RwhecError,
    RwhecWarning,
    TargetError,
    UnderdeterminedError,
)
from gtsam_rwhec.files.progress import Progress
from gtsam_rwhec.fitting.corner_findings import DETECTOR_PX, is_doubtful, lens_that_was_left_out
from gtsam_rwhec.fitting.corner_refinement import refine_corners
from gtsam_rwhec.fitting.corners_as_refined import as_refined, intrinsics_of, numbers_of
from gtsam_rwhec.fitting.corners_refined import CornersRefined, RefinedIntrinsics
from gtsam_rwhec.fitting.fit_options import CarrierNoise, CornerOptions
from gtsam_rwhec.fitting.held_out import LeftOut, left_out
from gtsam_rwhec.fitting.noise_in_data import NoiseInData
from gtsam_rwhec.fitting.observations import Observations, Views, check_corners_can_hold, check_corners_everywhere
from gtsam_rwhec.fitting.refined import Refined
from gtsam_rwhec.fitting.refinement import as_stated, beyond_independent_errors, observed
from gtsam_rwhec.fitting.reprojection_record import Intrinsics, Reprojection, TriedModel
from gtsam_rwhec.geometry.poses import Array, PoseLike
from gtsam_rwhec.problem.corners import candidates_of
from gtsam_rwhec.problem.measurements import Pair
from gtsam_rwhec.problem.problem import Problem
from gtsam_rwhec.problem.selection import nearer_poses, selected, with_poses
from gtsam_rwhec.solver.solution import solve

#: At most so many images are looked at, and of a pair at least so many.
MOST_IMAGES, FEWEST_OF_PAIR = 120, 8
#: Images are left out in so many blocks; of so few images, in more: the rest must still tell what all of them tell.
FOLDS, FEW_IMAGES, FOLDS_OF_FEW = 4, 50, 8
#: A counts as exact where the error is below this share of that with its noise.
BETTER_SHARE = 0.95


@dataclass(frozen=True)
class Score:
    """A model with its error in images that were left out, and the one that its covariances make one expect."""

    words: str
    px: float
    mm: float
    expected_px: float

    @property
    def in_words(self) -> str:
        """The error on the target, with the model."""
        size = f"{self.mm:.3g} mm" if np.isfinite(self.mm) else "a target behind its camera"
        return f"{size} with {self.words}"


@dataclass(frozen=True, eq=False)
class Tried:
    """The model that was chosen."""

    options: CornerOptions
    words: str  #: What it takes as known of A and of sizes
    evidence: str
    scores: tuple[Score, ...]  #: Of all models, the chosen one first; empty where images are too few
    left_out: LeftOut  #: Of the chosen one; empty where images are too few


def chosen_model(
    observations: Observations,
    X: Mapping[str, PoseLike],
    Y: Mapping[str, PoseLike],
    options: CornerOptions,
    tell: Progress,
    thin: CornersRefined | None = None,
) -> Tried:
    """The options under which images that were left out are predicted best: those given, or with A as exact.

    Raises as ``refine_corners`` does.
    """
    some = thinned(observations)
    try:
        first = _scored(some, X, Y, options, tell, thin)
    except CountError as error:
        return Tried(options, in_words(options), f"no other was tried: {error}", (), LeftOut({}, {}))
    every = [first]
    if options.carrier_noise != "exact":
        every.append(_scored(some, X, Y, replace(options, carrier_noise="exact"), tell))
    chosen, score, found = every[-1] if every[-1][1].mm < BETTER_SHARE * first[1].mm else first
    rest = tuple(one for _, one, _ in every if one is not score)
    evidence = f"it predicts images that were left out to {score.px:.3g} px, and {score.mm:.3g} mm on the target"
    if rest:
        evidence += f" ({', '.join(one.in_words for one in rest)})"
    return Tried(chosen, score.words, evidence, (score, *rest), found)


def thinned(observations: Observations) -> Observations:
    """At most so many images of each pair, evenly over their order."""
    most = max(MOST_IMAGES // len(observations.views), FEWEST_OF_PAIR)

    def some(view: Views) -> Views:
        number = len(view.A)
        at = np.unique(np.linspace(0, number - 1, min(number, most)).round().astype(np.int64))
        return view.selected(at)

    return replace(observations, views={pair: some(view) for pair, view in observations.views.items()})


def _scored(
    observations: Observations,
    X: Mapping[str, PoseLike],
    Y: Mapping[str, PoseLike],
    options: CornerOptions,
    tell: Progress,
    thin: CornersRefined | None = None,
) -> tuple[CornerOptions, Score, LeftOut]:
    refined = thin or refine_corners(observations, X, Y, options, tell)
    folds = FOLDS_OF_FEW if len(refined.point.A) < FEW_IMAGES else FOLDS
    found = left_out(observations, refined, options, folds=folds, progress=tell)
    errors = found.errors
    weights = np.array([one.corners for one in errors.values()], dtype=float)

    def mean(values: list[float]) -> float:
        return float(np.sqrt(weights @ np.square(values) / weights.sum()))

    px, mm, expected = (
        mean([getattr(one, name) for one in errors.values()]) for name in ("rms_px", "rms_mm", "expected_px")
    )
    return options, Score(in_words(options), px, mm, expected), found


def in_words(options: CornerOptions) -> str:
    """What the options take as known of A and of sizes."""
    noise = options.carrier_noise
    if isinstance(noise, CarrierNoise):
        of_A = f"A's noise as stated ({np.degrees(noise.rotation_rad):.2g}° and {1e3 * noise.translation_m:.2g} mm)"
    else:
        of_A = "A as exact" if noise == "exact" else "A's noise estimated"
    shares = options.size_share.values() if isinstance(options.size_share, Mapping) else (options.size_share,)
    if not any(shares):
        return f"{of_A} and sizes as stated"
    if not isinstance(options.size_share, Mapping):
        return f"{of_A} and sizes estimated"
    free = [name for name, share in options.size_share.items() if share]
    return f"{of_A} and {f'the size of {free[0]}' if len(free) == 1 else 'some sizes'} estimated"


#: What is chosen: the measurements that the answer is from.
MEASUREMENTS = "refinement"
#: Standard deviation of a size that is estimated, a share of 1.
SIZE_SHARE = 0.2
#: A growth of standard deviations below this is not said.
SEEN_GROWTH = 1.05
#: Images that were left out are off by more than this times what covariances say, where the model lacks something.
UNEXPLAINED = 1.5
#: Exact intrinsics that are off by more deviations of a calibration than this make wrong poses.
SURE_SIGMAS = 5.0


@dataclass(frozen=True, eq=False)
class CornersFound:
    """What the corners gave."""

    corners: CornersRefined | None  #: None where they give no better answer than the poses
    intrinsics: dict[str, Intrinsics]
    reprojection: Reprojection | None
    choices: tuple[Choice, ...]
    findings: tuple[Finding, ...]
    #: By how much each unknown's deviations are widened, since images that were left out are farther off than the
    #: covariances say; empty where they are not
    wider: Mapping[tuple[str, str], float] = field(default_factory=dict)

    @staticmethod
    def none(why: str, *findings: Finding) -> CornersFound:
        """Nothing, and why; with what that says against the poses of the same images."""
        choice = Choice(MEASUREMENTS, "from the poses of targets in the images", why)
        return CornersFound(None, {}, None, (choice,), findings)

    @property
    def contradicted(self) -> tuple[str, ...]:
        """Sensors whose stated intrinsics the corners contradict."""
        corners = self.corners
        if corners is None:
            return ()
        return tuple(name for name, one in corners.intrinsics.items() if one.innovation.is_contradicted)

    def refined(self, base: Refined, noise: NoiseInData | None) -> Refined:
        """The answer: from the corners, with what the poses (`base`) say of their noise; `base` where there is none."""
        if self.corners is None or self.reprojection is None:
            return base
        more = beyond_independent_errors(self.corners, noise, self.wider)
        return as_refined(base, self.corners, self.reprojection, self.intrinsics, more)


def corners_found(
    X: Mapping[str, PoseLike],
    Y: Mapping[str, PoseLike],
    observations: Observations,
    options: CornerOptions,
    tell: Progress,
    thin: CornersRefined | None = None,
    far_off: Collection[str] = (),
) -> CornersFound:
    """Refine from corners under the options, or with A as exact where that predicts images better.

    Parameters
    ----------
    X, Y : dict of str to pose
        The start: the answer from the poses of the same images.
    observations : Observations
    options : CornerOptions
    tell : callable
    thin : CornersRefined, optional
        The refinement of ``thinned(observations)`` under the options, where it was made already.
    far_off : collection of str
        Sensors whose stated intrinsics do not fit their corners, and count as unknown.
    """
    try:
        tried = chosen_model(observations, X, Y, options, tell, thin)
        tell("refining from corners")
        corners = refine_corners(observations, X, Y, tried.options, tell)
    except OutlierError as error:
        return CornersFound.none(f"the corners give none: {error}", Finding(Ground.CORNERS_DOUBTED, str(error)))
    except (CameraError, UnderdeterminedError) as error:
        words = (
            f"the poses of targets take the stated intrinsics as exact, and the corners do not confirm them: {error}"
        )
        return CornersFound.none(f"the corners give none: {error}", Finding(Ground.CORNERS_DOUBTED, words))
    except RwhecError as error:
        return CornersFound.none(f"the corners give none: {error}")
    if is_doubtful(corners):
        return CornersFound.none(
            f"the corners do not fit together: {' '.join(corners.findings)}", *_against_poses(corners)
        )
    intrinsics = intrinsics_of(corners, {name: options.stated_of(options.camera_of(name)) for name in corners.Y})
    faults = [f"{name}: {one.fault}" for name, one in intrinsics.items() if one.fault]
    if faults:
        why = f"the corners lead to intrinsics that no camera has ({'; '.join(faults)})"
        return CornersFound.none(why, Finding(Ground.CORNERS_DOUBTED, why))
    return CornersFound(
        corners,
        intrinsics,
        numbers_of(observations, corners, tried.options, tried.left_out.errors, _tried_models(tried)),
        tuple(_corner_choices(observations, corners, tried, intrinsics, far_off)),
        (*_corner_findings(corners, tried, intrinsics), *_against_exact(observations, corners, tried.options)),
        _wider(tried),
    )


def _against_poses(corners: CornersRefined) -> Iterator[Finding]:
    """What corners that do not fit together say against poses of single images: these are of the same corners.

    Noise of A alone says nothing against them: the noise of the poses has it.
    """
    px = corners.noise.corner_px
    if px > DETECTOR_PX:
        words = (
            f"the corners of the images do not fit together: they are off by {px:.2g} pixels, more than a detector's "
            "noise, and the poses are of the same corners"
        )
        yield Finding(Ground.CORNERS_DOUBTED, words)


def _against_exact(observations: Observations, corners: CornersRefined, options: CornerOptions) -> Iterator[Finding]:
    """Where intrinsics count as exact no residual is large for certain: freed as a calibration's are, they may move."""
    exact = [name for name in corners.Y if options.stated_of(options.camera_of(name)) == "exact"]
    if not exact:
        return
    stated = {name: options.stated_of(name) for name in corners.Y}
    stated |= {options.camera_of(name): "calibration" for name in exact}
    try:
        free = refine_corners(thinned(observations), corners.X, corners.Y, replace(options, stated=stated))
    except RwhecError:  # images that do not determine intrinsics do not contradict them
        return
    for name in exact:
        innovation = free.intrinsics[name].innovation
        if innovation.is_contradicted:
            is_sure = innovation.deviations > SURE_SIGMAS
            words = (
                f"the intrinsics of {name} count as exact, as an option says, and its corners contradict them "
                f"({innovation.deviations:.2g} deviations of a calibration off)"
            )
            yield Finding(Ground.INTRINSICS_DOUBTED if is_sure else Ground.INTRINSICS_UNCERTAIN, words)


def _tried_models(tried: Tried) -> tuple[TriedModel, ...]:
    """The models in numbers; without those that put a target behind its camera."""
    best = tried.scores[:1]
    return tuple(TriedModel(one.words, one.px, one.mm, one in best) for one in tried.scores if np.isfinite(one.px))


def _corner_choices(
    observations: Observations,
    corners: CornersRefined,
    tried: Tried,
    intrinsics: Mapping[str, Intrinsics],
    far_off: Collection[str],
) -> Iterator[Choice]:
    number = sum(int(view.known.sum()) for view in observations.views.values())
    number -= sum(int(mask.sum()) for mask in corners.left_out.values())
    chosen = f"from {number} corners ({corners.noise.corner_px:.2g} px), with {tried.words}"
    yield Choice(MEASUREMENTS, chosen, tried.evidence)
    growth = growth_by_intrinsics(corners)
    for name, one in intrinsics.items():
        if one.stated_as == "exact":
            yield Choice(f"intrinsics of {name}", "as stated, which count as exact", "an option says so")
            continue
        known = {
            "calibration": "a calibration states them, and may be off by as much as calibrations are",
            "nominal": "the stated ones count as nominal (write stated: calibration where a calibration states them)",
            "unknown": "none are stated",
        }.get(one.stated_as, "")
        if one.stated_as == "unknown" and name in far_off:
            known = "the stated ones do not fit the corners, and count as unknown"
        innovation = corners.intrinsics[name].innovation
        if innovation.is_contradicted and one.stated_as != "unknown":
            known = f"the stated ones are contradicted by {innovation.deviations:.2g} deviations"
            if one.widened > 1.0:
                known += f", and the prior about them was made {one.widened:.2g} times as wide"
        found = "estimated with the poses"
        if growth[name] > SEEN_GROWTH:
            found += f", which makes standard deviations of {name} up to {growth[name]:.2g} times those of exact ones"
        lens = lens_that_was_left_out(corners, [name])
        if lens:
            found += f"; no distortion is stated, and {lens}"
        if one.held_by_prior:
            found += f"; {', '.join(one.held_by_prior)} about as stated, since the images do not tell them"
        yield Choice(f"intrinsics of {name}", found, known)


def growth_by_intrinsics(corners: CornersRefined) -> dict[str, float]:
    """By sensor: the largest ratio of a standard deviation of its pose to that with exact intrinsics.

    With exact intrinsics k the covariance of the rest e is C_ee - C_ek C_kk^-1 C_ke.
    """
    held = [np.arange(at.start, at.stop) for (letter, _), at in corners.slots.items() if letter == "k"]
    if not held:
        return dict.fromkeys(corners.Y, 1.0)
    k, C = np.concatenate(held), corners.joint
    size = np.sqrt(np.diagonal(C)[k])
    found = {}
    for name in corners.Y:
        e = np.arange(corners.slots["y", name].start, corners.slots["y", name].stop)
        across = C[np.ix_(e, k)] / size
        by_k = across @ np.linalg.solve(C[np.ix_(k, k)] / np.outer(size, size), across.T)
        known = np.diagonal(C)[e] - np.diagonal(by_k)
        found[name] = float(np.sqrt((np.diagonal(C)[e] / np.maximum(known, 1e-300)).max()))
    return found


def _corner_findings(corners: CornersRefined, tried: Tried, intrinsics: Mapping[str, Intrinsics]) -> Iterator[Finding]:
    for name, one in intrinsics.items():
        innovation = corners.intrinsics[name].innovation
        if innovation.is_contradicted:
            before, after = (np.rint(camera.K).astype(int) for camera in (one.stated_camera, one.camera))
            stated, found = (f"fx, fy = {K[0, 0]}, {K[1, 1]}; cx, cy = {K[0, 2]}, {K[1, 2]}" for K in (before, after))
            words = (
                f"the intrinsics of {name}, as stated ({stated}), do not fit its corners ({innovation.deviations:.2g} "
                f"deviations off); the estimated ones ({found}) are used"
            )
            yield Finding(Ground.INTRINSICS_ESTIMATED, words)
        lens = lens_that_was_left_out(corners, [name])
        if lens and one.stated_as == "calibration":
            words = f"the intrinsics of {name} are stated without distortion, and its corners show one: {lens}"
            yield Finding(Ground.INTRINSICS_ESTIMATED, words)
    times = _unexplained(tried)
    if times > 1.0:
        words = (
            f"images that were left out are predicted to {tried.scores[0].mm:.2g} mm on the target, {times:.2g} times "
            "as far off as the noise of corners and of A explains: the arm's poses, or the target, have systematic "
            "errors, and the standard deviations are widened by as much, or as blocks of images disagree"
        )
        yield Finding(Ground.SYSTEMATIC, words)


def _wider(tried: Tried) -> dict[tuple[str, str], float]:
    """Where errors are unexplained: as much as these are, or as blocks of images disagree, whichever is more."""
    times = _unexplained(tried)
    return {slot: max(times, spread) for slot, spread in tried.left_out.spread.items()} if times > 1.0 else {}


def _unexplained(tried: Tried) -> float:
    """How many times as far off as the covariances say images are that were left out; 1 where that is by chance."""
    times = tried.scores[0].px / tried.scores[0].expected_px if tried.scores else 1.0
    return times if times > UNEXPLAINED else 1.0


#: Poses of targets are computed again at most so often.
MOST_TIMES = 2
#: Intrinsics are other ones than the stated ones where a parameter is off by so many standard deviations, and the image
#: by so many pixels (root mean square).
OTHER_SIGMAS, OTHER_PX = 3.0, 0.5
#: So many columns and rows of the image are looked at.
LOOKED_AT = 9


def check_observations(problem: Problem, options: CalibrateOptions) -> None:
    """A CountError or OptionError where corners are wanted, and the problem lacks them, or holds what they cannot."""
    if options.observations == "corners":
        check_corners_everywhere(problem)
        check_corners_can_hold(problem)


def with_better_poses(run: Run, found: Answer) -> tuple[Run | None, CornersRefined | None]:
    """The run again with images whose poses are those that the answer says, or None where they have them already.

    Intrinsics are looked at once, in a part of the images where they are many; beside it is what these say. A log's
    were looked at before: `with_estimated_intrinsics`.
    """
    base = found.refined
    if base is None or base.free_directions or not run.problem.boards or run.times > MOST_TIMES or run.recording:
        return None, None
    X, Y, cameras, corners = base.X, base.Y, dict(run.cameras), None
    if run.options.observations != "poses" and not _why_not(run, base):
        observations, options, _ = _observed(run, found)
        try:
            corners = refine_corners(thinned(observations), X, Y, options, run.tell)
        except RwhecError:  # then the answer is from the poses, and says why
            return None, None
        if is_doubtful(corners):
            return None, corners
        X, Y = corners.X, corners.Y
        for name, one in corners.intrinsics.items():
            if name not in cameras and _have_moved(one, run.problem.cameras[name]):
                cameras[name] = one.camera
    is_new = len(cameras) > len(run.cameras)
    try:
        better, changed = nearer_poses(run.problem, X, Y, cameras)
    except (CameraError, TargetError):  # a lens without a ray for a corner, or a target that is not flat
        return None, corners
    return run.again(better, cameras) if is_new or changed else None, corners


@dataclass(frozen=True, eq=False)
class ByCorners:
    """What corners gave, the answer from the poses that they started from, and how many measurements have none."""

    found: CornersFound
    start: Refined
    without: dict[Pair, int] = field(default_factory=dict)


def with_estimated_intrinsics(run: Run, base: Refined, inliers: Inliers) -> tuple[Run, ByCorners]:
    """What the corners of a log give, and the run with poses of targets by the intrinsics that they tell.

    ``base`` is an answer from the poses of the inliers. Where the corners contradict the stated intrinsics, the run is
    at its beginning.
    """
    kept = replace(run, problem=selected(run.problem, inliers) if inliers else run.problem)
    why = "an option says so" if run.options.observations == "poses" else _why_not(kept, base)
    if why:
        return run, ByCorners(CornersFound.none(why), base)
    observations, options, without = _observed(kept, Answer(base.solution, refined=base))
    far_off = () if run.recording is None else run.recording.far_off
    found = corners_found(base.X, base.Y, observations, options, run.tell, far_off=far_off)
    by = ByCorners(found, base, without)
    corners = by.found.corners
    if corners is None:
        return run, by
    run.tell("computing the poses of targets again, with the estimated intrinsics")
    try:
        cameras = {name: one.camera for name, one in corners.intrinsics.items()}
        better, _ = nearer_poses(run.problem, corners.X, corners.Y, cameras)
    except (CameraError, TargetError):  # a lens without a ray for a corner, or a target that is not flat
        return run, by
    if by.found.contradicted and run.times <= MOST_TIMES:
        return run.again(better, cameras), by
    return replace(run, problem=better, cameras=cameras), by


def answered_by_corners(
    run: Run, found: Answer, thin: CornersRefined | None = None, by: ByCorners | None = None
) -> Answer:
    """The answer from the corners, where the problem has them and they give a better one; what was chosen is noted.

    ``thin``: what a part of the images says already; ``by``: what all of them do.
    """
    base = found.refined
    if base is None or run.options.observations == "poses" or not (run.problem.boards or run.recording):
        return found
    if by is None and (why := _why_not(run, base)):
        by = ByCorners(CornersFound.none(why), base)
    elif by is None:
        observations, options, without = _observed(run, found)
        by = ByCorners(corners_found(base.X, base.Y, observations, options, run.tell, thin), base, without)
    elif base.free_directions and by.found.corners is not None:
        by = ByCorners(CornersFound.none("the motion leaves poses free"), base)
    of_corners, without = by.found, by.without
    run.record.choices += of_corners.choices
    run.record.findings += of_corners.findings
    if of_corners.corners is None:
        return found
    if without:
        counts = ", ".join(f"{number} of {pair}" for pair, number in without.items())
        run.record.choose("measurements without corners", f"{counts} do not count in the poses", "the others have some")
    return replace(found, refined=as_stated(of_corners.refined(base, found.noise.model), by.start, of_corners.corners))


def _why_not(run: Run, base: Refined) -> str:
    """Why the problem's corners cannot be refined from; empty where they can."""
    problem = run.problem
    if not problem.boards:
        return "no measurement has corners and a camera's intrinsics"
    if any(pair.is_motion for pair in problem.pairs):
        return "the poses of targets are solved together with the motions of odometries"
    # A driver may leave out the corners of a few detections of a log; nothing else that was stated is passed over.
    few = {pair: has for pair, has in _with_corners(problem).items() if not has.all()}
    if lacking := [
        f"{pair} ({(~has).sum()} of {len(has)})" for pair, has in few.items() if run.recording is None or not has.any()
    ]:
        return f"measurements without corners: {', '.join(lacking[:5])}"
    try:
        check_corners_can_hold(problem)
    except OptionError as error:
        return str(error)
    return "the motion leaves poses free" if base.free_directions else ""


def _with_corners(problem: Problem) -> dict[Pair, np.ndarray]:
    """Which measurements of each pair (N,) have corners."""
    found: dict[Pair, np.ndarray] = {}
    for pair in problem.pairs:
        pixels = problem.measurements(*pair).pixels
        none = np.zeros(problem.moments(*pair).count, dtype=bool)
        found[pair] = none if pixels is None else np.asarray(np.isfinite(pixels).any(axis=(1, 2)))
    return found


def _observed(run: Run, found: Answer) -> tuple[Observations, CornerOptions, dict[Pair, int]]:
    """The corners of the images that agree with the answer, the options, and how many measurements have none."""
    base, problem = found.refined, run.problem
    assert base is not None
    noise, model = run.options.carrier_noise, found.noise.model
    options = run.options.corners or CornerOptions(
        carrier_noise="estimate" if noise is None or noise.covariances is not None else noise,
        about="targetcarrier" if model is None else model.hand,
    )
    has = _with_corners(problem)
    inliers = base.inliers or {pair: np.ones(len(mask), dtype=bool) for pair, mask in has.items()}
    without = {pair: number for pair, mask in has.items() if (number := int((inliers[pair] & ~mask).sum()))}
    if not all(mask.all() for mask in has.values()):
        problem = selected(problem, has)
        base = replace(base, inliers={pair: inliers[pair][mask] for pair, mask in has.items()})
    observations, options = observed(problem, base, options, run.options.carrier_path)
    return observations, options, without


def _have_moved(found: RefinedIntrinsics, stated: Camera) -> bool:
    """Whether intrinsics are surely others than the stated ones, and by enough to move poses."""
    size = np.array([stated.width, stated.height])
    pixels = np.stack(np.meshgrid(*np.linspace(0.0, size - 1.0, LOOKED_AT).T), axis=-1)
    off = np.linalg.norm(stated.pixels(found.camera.undistort(pixels)) - pixels, axis=-1)
    is_sure = bool((np.abs(found.innovation.off) > OTHER_SIGMAS * np.array(found.standard_deviations)).any())
    return is_sure and bool(np.nanmean(off**2) > OTHER_PX**2)


def by_told_intrinsics(run: Run, sensors: Collection[str]) -> Run:
    """The run from its beginning with poses of targets by intrinsics that a sensor's images of flat boards tell alone.

    They count as unknown then. Raises CameraError where the images determine none, or an image has no pose by them.
    """
    problem = run.problem
    told: dict[str, Camera] = {}
    for name in sensors:
        stated = problem.cameras[name]
        seen = [
            (problem.boards[pair.target][known], image[known])
            for pair in problem.pairs
            if pair.sensor == name and pair.target in problem.boards and not problem.boards[pair.target][:, 2].any()
            for image in _images(problem, pair)
            if (known := np.isfinite(image[:, 0])).sum() >= CORNERS
        ]
        lens: Lens = "equidistant" if stated.model == "equidistant" else "any"
        boards, pixels = [board for board, _ in seen], [image for _, image in seen]
        told[name] = estimated_intrinsics(boards, pixels, (stated.width, stated.height), lens).camera
    again = by_intrinsics(problem, told)
    corners = run.options.corners or CornerOptions()
    of_cameras = {name: "unknown" if name in told else corners.stated_of(name) for name in problem.cameras}
    options = replace(run.options, corners=replace(corners, stated=of_cameras))
    return replace(run.attempt(), problem=again, options=options, times=2)


def _images(problem: Problem, pair: Pair) -> Array:
    pixels = problem.measurements(*pair).pixels
    return np.zeros((0, 0, 2)) if pixels is None else pixels[np.isfinite(pixels).any(axis=(1, 2))]


def by_intrinsics(problem: Problem, cameras: Mapping[str, Camera]) -> Problem:
    """The problem with poses of targets by other intrinsics; of a plane's two, those near a certified solution."""
    every = {}
    for pair in problem.pairs:
        raw = every[pair] = problem.measurements(*pair)
        if pair.sensor not in cameras or raw.pixels is None:
            continue
        rows = np.flatnonzero(np.isfinite(raw.pixels).any(axis=(1, 2)))
        both = candidates_of(
            cameras[pair.sensor], problem.boards[pair.target], raw.pixels[rows], problem.corner_px or 0.1, pair.label
        )
        every[pair] = with_poses(raw, rows, *both.chosen(both.by_carriers(raw.A[rows])))
    again = problem.with_measurements(every)
    again.cameras = {**problem.cameras, **cameras}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RwhecWarning)  # of weights: no outlier is left out yet
        solution = solve(again)
    return nearer_poses(again, solution.X, solution.Y)[0]
