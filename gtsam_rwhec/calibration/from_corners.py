"""The answer from corners: held-out images choose the noise model; target poses are computed again where needed.

The poses of boards come first: they give the certified start, the outlier images, and the noise in time and over the
configuration. The corners then give the answer, with the cameras' intrinsics as variables. The board poses used the
stated intrinsics, and a flat board has two possible poses: where the answer disagrees, they are computed again.
"""

from __future__ import annotations

import warnings
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from gtsam_rwhec.calibration.calibrate_options import CalibrateOptions, Inliers, Run, agreeing
from gtsam_rwhec.calibration.clock_offsets import Answer
from gtsam_rwhec.calibration.corner_models import (
    SEEN_GROWTH,
    Tried,
    choices_of,
    chosen_model,
    findings_of,
    growth_by_intrinsics,
    thinned,
)
from gtsam_rwhec.calibration.verdict import Choice, Finding, Ground
from gtsam_rwhec.cameras.camera import Camera
from gtsam_rwhec.cameras.unknown_intrinsics import CORNERS, Lens, estimated_intrinsics
from gtsam_rwhec.errors import (
    CameraError,
    OptionError,
    OutlierError,
    RwhecError,
    RwhecWarning,
    TargetError,
    UnderdeterminedError,
)
from gtsam_rwhec.files.progress import Progress
from gtsam_rwhec.fitting.camera_choice import with_widest
from gtsam_rwhec.fitting.corner_findings import DETECTOR_PX, is_doubtful, lens_that_was_left_out
from gtsam_rwhec.fitting.corner_refinement import refine_corners
from gtsam_rwhec.fitting.corners_as_refined import as_refined, intrinsics_of, numbers_of
from gtsam_rwhec.fitting.corners_refined import CornersRefined, RefinedIntrinsics
from gtsam_rwhec.fitting.fit_options import CornerOptions
from gtsam_rwhec.fitting.noise_in_data import NoiseInData
from gtsam_rwhec.fitting.observations import Observations, check_corners_can_hold, check_corners_everywhere
from gtsam_rwhec.fitting.readmission import agreeing_by_corners
from gtsam_rwhec.fitting.refined import Refined
from gtsam_rwhec.fitting.refinement import as_stated, beyond_independent_errors, observed
from gtsam_rwhec.fitting.reprojection_record import Intrinsics, Reprojection, TriedModel
from gtsam_rwhec.geometry.poses import Array, PoseLike
from gtsam_rwhec.problem.corners import candidates_of
from gtsam_rwhec.problem.measurements import Pair
from gtsam_rwhec.problem.problem import Problem
from gtsam_rwhec.problem.selection import nearer_poses, selected, with_poses
from gtsam_rwhec.solver.solution import solve

#: The name of this choice: whether the answer is from corners or from poses.
MEASUREMENTS = "refinement"


@dataclass(frozen=True, eq=False)
class CornersFound:
    """The result of the refinement from corners."""

    corners: CornersRefined | None  #: None where they give no better answer than the poses
    intrinsics: dict[str, Intrinsics]
    reprojection: Reprojection | None
    choices: tuple[Choice, ...]
    findings: tuple[Finding, ...]
    #: The factor on each unknown's standard deviations, where images that were left out show them to be too small
    wider: Mapping[tuple[str, str], float] = field(default_factory=dict)
    start: Refined | None = None  #: The answer from poses that was its start
    tried: Tried | None = None  #: The models that were compared
    without: dict[Pair, int] = field(default_factory=dict)  #: How many measurements have no corners, by pair

    @staticmethod
    def none(why: str, *findings: Finding) -> CornersFound:
        """No answer from corners, and why; with findings against the poses of the same images."""
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
        """The answer from corners, with the noise that the poses (`base`) show; `base` if there is none."""
        if self.corners is None or self.reprojection is None:
            return base
        more = beyond_independent_errors(self.corners, noise, self.wider)
        if self.tried is not None:
            more = more + self.tried.covariance_of_rivals(self.corners)
        return as_refined(base, self.corners, self.reprojection, self.intrinsics, more)


def corners_found(
    X: Mapping[str, PoseLike],
    Y: Mapping[str, PoseLike],
    observations: Observations,
    options: CornerOptions,
    tell: Progress,
    thin: CornersRefined | None = None,
    far_off: Collection[str] = (),
    tried: Tried | None = None,
) -> CornersFound:
    """Refine from corners with the given options, or with A as exact if this predicts held-out images better.

    Parameters
    ----------
    X, Y : dict of str to pose
        The start: the answer from the poses of the same images.
    observations : Observations
    options : CornerOptions
    tell : callable
    thin : CornersRefined, optional
        The refinement of ``thinned(observations)`` with everything free, where it was made already.
    far_off : collection of str
        Sensors whose stated intrinsics do not fit their corners, and count as unknown.
    tried : Tried, optional
        The models that were compared before, on most of these images; left out, they are compared.
    """
    try:
        tried = tried or chosen_model(observations, X, Y, options, tell, thin)
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
        words = f"intrinsics, and errors that images share, were not looked for in the corners: {error}"
        return CornersFound.none(f"the corners give none: {error}", Finding(Ground.NOT_CHECKED, words))
    if is_doubtful(corners):
        px, words = corners.noise.corner_px, " ".join(corners.findings)
        # The poses are of the same corners; noise of A alone is no finding, since the poses' noise model contains it.
        against = (
            f"the corners of the images do not fit together: they are off by {px:.2g} pixels, more than a detector's "
            "noise, and the poses are of the same corners"
        )
        findings = [Finding(Ground.CORNERS_DOUBTED, against)] if px > DETECTOR_PX else []
        return CornersFound.none(f"the corners do not fit together: {words}", *findings)
    intrinsics = intrinsics_of(corners, {name: options.stated_of(options.camera_of(name)) for name in corners.Y})
    faults = [f"{name}: {one.fault}" for name, one in intrinsics.items() if one.fault]
    if faults:
        why = f"the corners lead to intrinsics that no camera has ({'; '.join(faults)})"
        return CornersFound.none(why, Finding(Ground.CORNERS_DOUBTED, why))
    scores = tried.scores  # without models that put a target behind its camera
    models = tuple(TriedModel(one.words, one.px, one.mm, one is scores[0]) for one in scores if np.isfinite(one.px))
    return CornersFound(
        corners,
        intrinsics,
        numbers_of(observations, corners, tried.options, tried.held_out, models),
        tuple(_corner_choices(observations, corners, tried, intrinsics, far_off)),
        tuple(findings_of(observations, corners, tried, intrinsics)),
        {slot: factor for slot, factor in tried.wider.items() if slot in corners.slots},
        tried=tried,
    )


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
    yield from choices_of(tried)
    growth = growth_by_intrinsics(corners)
    for name, one in intrinsics.items():
        if one.stated_as == "exact":
            yield Choice(f"intrinsics of {name}", "as stated, which count as exact", "it is said so")
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


#: Target poses are computed again at most so many times.
MOST_TIMES = 2
#: Intrinsics differ from the stated ones if a parameter changed by so many standard deviations, and the image by so
#: many pixels (root mean square).
OTHER_SIGMAS, OTHER_PX = 3.0, 0.5
#: Columns and rows of the pixel grid on which the two are compared.
LOOKED_AT = 9


def check_observations(problem: Problem, options: CalibrateOptions) -> None:
    """Raise a CountError or OptionError if corners are asked for, and the problem lacks them or does not allow them."""
    if options.observations == "corners":
        check_corners_everywhere(problem)
        check_corners_can_hold(problem)


def with_better_poses(run: Run, found: Answer) -> tuple[Run | None, CornersRefined | None]:
    """A new run with target poses computed again by the answer; None if they do not change.

    Intrinsics are checked once; of many images a part is used, and its refinement is returned too. Those of a log were
    checked before: `with_estimated_intrinsics`.
    """
    base = found.refined
    if base is None or base.free_directions or not run.problem.boards or run.times > MOST_TIMES or run.recording:
        return None, None
    X, Y, cameras, corners = base.X, base.Y, dict(run.cameras), None
    if not _why_not(run, base):
        observations, options, _ = _observed(run, base, found.noise.model)
        try:
            widest = with_widest(options, observations)
            corners = refine_corners(thinned(observations), X, Y, widest, run.tell)
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


def _from_corners(
    run: Run,
    base: Refined,
    noise: NoiseInData | None = None,
    thin: CornersRefined | None = None,
    tried: Tried | None = None,
) -> CornersFound:
    """What the corners of the images give that agree with an answer from their poses, with the noise of these."""
    if why := _why_not(run, base):
        return replace(CornersFound.none(why), start=base)
    observations, options, without = _observed(run, base, noise)
    far_off = () if run.recording is None else run.recording.far_off
    found = corners_found(base.X, base.Y, observations, options, run.tell, thin, far_off, tried)
    return replace(found, start=base, without=without)


def with_estimated_intrinsics(run: Run, base: Refined, inliers: Inliers) -> tuple[Run, CornersFound, Inliers]:
    """The run with target poses by the intrinsics that a log's corners give, what these corners give, and inliers.

    ``base`` is an answer from the poses of the inliers. Images whose corners agree are inliers, too. If the corners
    contradict the stated intrinsics, the run starts again.
    """
    found, inliers = _with_readmitted(run, base, inliers)
    corners = found.corners
    if corners is None:
        return run, found, inliers
    run.tell("computing the poses of targets again, with the estimated intrinsics")
    try:
        cameras = {name: one.camera for name, one in corners.intrinsics.items()}
        better, _ = nearer_poses(run.problem, corners.X, corners.Y, cameras)
    except (CameraError, TargetError):  # a lens without a ray for a corner, or a target that is not flat
        return run, found, inliers
    if found.contradicted and run.times <= MOST_TIMES:
        return run.again(better, cameras), found, inliers
    return replace(run, problem=better, cameras=cameras), found, inliers


def _with_readmitted(
    run: Run, base: Refined, inliers: Inliers, noise: NoiseInData | None = None, thin: CornersRefined | None = None
) -> tuple[CornersFound, Inliers]:
    """What the corners of the inliers give, and of images that their poses left out and whose corners agree."""
    every = replace(base, inliers={})
    found = _from_corners(replace(run, problem=agreeing(run.problem, inliers)), every, noise, thin)
    for _ in range(MOST_TIMES):
        more = None if found.corners is None else _readmitted(run, every, inliers, found.corners)
        if more is None:
            break
        run.tell("refining from corners, with images whose corners agree")
        again = _from_corners(replace(run, problem=agreeing(run.problem, more)), every, noise, tried=found.tried)
        if again.corners is None:
            break
        found, inliers = again, more
    return replace(found, start=base), inliers


def _readmitted(run: Run, base: Refined, inliers: Inliers, corners: CornersRefined) -> Inliers | None:
    """The inliers, with images that their poses left out and whose corners agree; None if there is none of these."""
    if not inliers or all(mask.all() for mask in inliers.values()):
        return None
    observations, _, _ = _observed(run, base, None)
    has = _with_corners(run.problem)
    kept = {pair: inliers[pair][has[pair]] for pair in map(Pair._make, observations.views)}
    found = agreeing_by_corners(observations, kept, corners)
    if all(np.array_equal(mask, kept[pair]) for pair, mask in found.items()):
        return None
    more = {pair: mask.copy() for pair, mask in inliers.items()}
    for pair, mask in found.items():
        more[pair][np.flatnonzero(has[pair])[mask]] = True
    return more


def answered_by_corners(
    run: Run, found: Answer, thin: CornersRefined | None = None, by: CornersFound | None = None
) -> Answer:
    """The answer from the corners, if the problem has them and they give a better one; the choice is recorded.

    ``thin``: the refinement of a part of the images, if there is one; ``by``: the result from all of them.
    """
    base = found.refined
    if base is None or run.options.observations == "poses" or not (run.problem.boards or run.recording):
        return found
    inliers, solution = found.inliers, found.solution
    if by is None:
        by, inliers = _with_readmitted(run, base, inliers, found.noise.model, thin)
        if by.corners is not None and inliers is not found.inliers:
            solution = solve(agreeing(run.problem, inliers), options=run.options.solve, progress=run.tell)
            base = replace(base, inliers=inliers)
    elif base.free_directions and by.corners is not None:
        by = CornersFound.none("the motion leaves poses free")
    run.record.choices += by.choices
    run.record.findings += by.findings
    if by.corners is None or by.start is None:
        return found
    if by.without:
        counts = ", ".join(f"{number} of {pair}" for pair, number in by.without.items())
        run.record.choose("measurements without corners", f"{counts} do not count in the poses", "the others have some")
    refined = as_stated(by.refined(base, found.noise.model), by.start, by.corners)
    return replace(found, refined=refined, inliers=inliers, solution=solution)


def _why_not(run: Run, base: Refined) -> str:
    """Why the problem's corners cannot be used; empty if they can."""
    problem = run.problem
    if run.options.observations == "poses":
        return "an option says so"
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


def _observed(
    run: Run, base: Refined, model: NoiseInData | None
) -> tuple[Observations, CornerOptions, dict[Pair, int]]:
    """The corners of the images that agree with the answer, the options, and how many measurements have none."""
    problem, noise = run.problem, run.options.carrier_noise
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
    """Whether intrinsics clearly differ from the stated ones, and by enough to move poses."""
    size = np.array([stated.width, stated.height])
    pixels = np.stack(np.meshgrid(*np.linspace(0.0, size - 1.0, LOOKED_AT).T), axis=-1)
    off = np.linalg.norm(stated.pixels(found.camera.undistort(pixels)) - pixels, axis=-1)
    is_sure = bool((np.abs(found.innovation.off) > OTHER_SIGMAS * np.array(found.standard_deviations)).any())
    return is_sure and bool(np.nanmean(off**2) > OTHER_PX**2)


def by_told_intrinsics(run: Run, sensors: Collection[str]) -> Run:
    """Start again with target poses by intrinsics that are estimated from the sensor's images of flat boards alone.

    These intrinsics then count as unknown. Raises CameraError if the images do not determine them, or an image has no
    pose.
    """
    problem = run.problem
    told: dict[str, Camera] = {}
    for name in sensors:
        stated = problem.cameras[name]
        seen = [
            (problem.boards[pair.target][known], image[known])
            for pair in problem.pairs
            if pair.sensor == name and pair.target in problem.boards and not problem.boards[pair.target][:, 2].any()
            for image in _pixels(problem, pair)
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


def _pixels(problem: Problem, pair: Pair) -> Array:
    """The corners (N, n, 2) of a pair's images; N = 0 where none has some."""
    pixels = problem.measurements(*pair).pixels
    return np.zeros((0, 0, 2)) if pixels is None else pixels


def by_intrinsics(problem: Problem, cameras: Mapping[str, Camera]) -> Problem:
    """The problem with target poses by other intrinsics; of a plane's two poses, the one near a certified solution."""
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
    with warnings.catch_warnings(action="ignore", category=RwhecWarning):  # of weights: no outlier is left out yet
        solution = solve(again)
    return nearer_poses(again, solution.X, solution.Y)[0]
