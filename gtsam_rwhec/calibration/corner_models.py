"""Which model of the corners predicts images that were left out: cameras, and whether A has noise."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace

import numpy as np

from gtsam_rwhec.calibration.verdict import Choice, Finding, Ground
from gtsam_rwhec.cameras.camera import Camera
from gtsam_rwhec.errors import CountError, RwhecError, UnderdeterminedError
from gtsam_rwhec.files.progress import Progress
from gtsam_rwhec.fitting.camera_choice import ChosenCameras, chosen_cameras, spread_of, with_widest
from gtsam_rwhec.fitting.corner_findings import lens_that_was_left_out
from gtsam_rwhec.fitting.corner_refinement import refine_corners
from gtsam_rwhec.fitting.corners_refined import CornersRefined
from gtsam_rwhec.fitting.fit_options import CarrierNoise, CornerOptions
from gtsam_rwhec.fitting.held_out import HeldOut, held_out_errors
from gtsam_rwhec.fitting.observations import Observations, Views
from gtsam_rwhec.fitting.reprojection_record import Intrinsics
from gtsam_rwhec.geometry.poses import Array, PoseLike

#: Images in the comparison of models: at most so many in all, but up to so many of each pair in any case; of very many
#: pairs at most so many in all again, but a few of each.
MOST_IMAGES, FEWEST_OF_PAIR = 120, 8
MOST_OF_MANY_PAIRS, FEW = 600, 3
#: Number of cross-validation folds; below `FEW_IMAGES` images more folds, so that enough images remain to calibrate
#: from.
FOLDS, FEW_IMAGES, FOLDS_OF_FEW = 4, 50, 8
#: A counts as exact if this lowers the held-out error by this share and more, and by more than chance does: an image's
#: corners are off together by what its A is off, which has so many numbers.
BETTER_SHARE, NUMBERS_OF_AN_IMAGE = 0.05, 6
#: If errors in held-out images are more than this many times what the covariances predict, the model is incomplete.
UNEXPLAINED = 1.5


@dataclass(frozen=True)
class Score:
    """A model, its error in held-out images, and the error that its covariances predict."""

    words: str
    px: float
    mm: float
    expected_px: float


@dataclass(frozen=True, eq=False)
class Tried:
    """The model that was chosen."""

    options: CornerOptions
    words: str  #: What it assumes about A and about sizes
    evidence: str
    scores: tuple[Score, ...]  #: Of all models, the chosen one first; empty where images are too few
    held_out: dict[str, HeldOut]  #: Of the chosen one, by sensor; empty where images are too few
    cameras: ChosenCameras  #: What is free of cameras, and how far blocks of images disagree
    images: int  #: How many were looked at

    @property
    def wider(self) -> dict[tuple[str, str], float]:
        """By unknown: the factor on its standard deviations, where blocks of images disagree by more."""
        # where errors are unexplained, all are so by as much, at least
        found = {at: max(self.unexplained, spread) for at, spread in self.cameras.spread.items()}
        return {at: factor for at, factor in found.items() if factor > 1.0}

    def covariance_of_rivals(self, corners: CornersRefined) -> Array:
        """The covariance (d, d) of the corners' unknowns from models that predict nearly as well as the chosen one.

        They were compared on some of the images; what noise does to their answers shrinks with more.
        """
        share = np.sqrt(min(self.images / max(sum(len(s.instant) for s in corners.graph.model.stacks), 1), 1.0))
        found = np.zeros_like(corners.joint)
        for rival in self.cameras.rivals:
            off = np.zeros(len(found))
            for slot, rows in corners.slots.items():
                if slot in rival:  # a pinhole's are the first of a lens's
                    number = min(rows.stop - rows.start, len(rival[slot]))
                    off[rows.start : rows.start + number] = share * rival[slot][:number]
            found += np.outer(off, off)
        return found

    @property
    def unexplained(self) -> float:
        """The ratio of held-out errors to those that the covariances predict; 1 if it may be chance."""
        times = self.scores[0].px / self.scores[0].expected_px if self.scores else 1.0
        return times if times > UNEXPLAINED else 1.0


def chosen_model(
    observations: Observations,
    X: Mapping[str, PoseLike],
    Y: Mapping[str, PoseLike],
    options: CornerOptions,
    tell: Progress,
    thin: CornersRefined | None = None,
) -> Tried:
    """The options that predict held-out images best: the simplest cameras, and A with its noise, or exact.

    ``thin`` is the refinement of ``thinned(observations)`` with everything free that may be (`with_widest`).

    Raises as ``refine_corners`` does.
    """
    some = thinned(observations)
    images = sum(len(view.A) for view in some.views.values())
    if thin is None:
        thin = refine_corners(some, X, Y, with_widest(options, some), tell)
    cameras = chosen_cameras(thin, some, options)
    if options.lens == "all" and cameras.asking:
        wide = refine_corners(some, thin.X, thin.Y, with_widest(options, some, cameras), tell)
        cameras = chosen_cameras(wide, some, options, cameras)
    options = cameras.options

    def scored(of: CornerOptions) -> tuple[CornersRefined, CornerOptions, Score, dict[str, HeldOut]]:
        refined = refine_corners(some, X, Y, of, tell)
        folds = FOLDS_OF_FEW if len(refined.point.A) < FEW_IMAGES else FOLDS
        found = held_out_errors(refined, folds=folds, progress=tell)
        errors = np.array([(one.rms_px, one.rms_mm, one.expected_px) for one in found.values()])
        weights = np.array([one.corners for one in found.values()], dtype=float)
        return refined, of, Score(in_words(of), *np.sqrt(weights @ errors**2 / weights.sum()).tolist()), found

    try:
        every = [scored(options)]
    except (CountError, UnderdeterminedError) as error:
        return Tried(options, in_words(options), f"no other was tried: {error}", (), {}, cameras, images)
    if options.carrier_noise != "exact":
        every.append(scored(replace(options, carrier_noise="exact")))
        chance = 2.0 / np.sqrt(NUMBERS_OF_AN_IMAGE * images)
        if every[1][2].mm < (1.0 - max(BETTER_SHARE, chance)) * every[0][2].mm:
            every.reverse()
    refined, chosen, score, found = every[0]
    if refined.noise.carrier is None:  # then what A is off makes an image's corners go together, and only blocks tell
        cameras = replace(cameras, spread=spread_of(refined, some, chosen))
    evidence = f"it predicts images that were left out to {score.px:.3g} px, and {score.mm:.3g} mm on the target"
    for _, _, other, _ in every[1:]:
        size = f"{other.mm:.3g} mm" if np.isfinite(other.mm) else "a target behind its camera"
        size += ", nearer by no more than chance," if other.mm < score.mm else ""
        evidence += f" ({size} with {other.words})"
    return Tried(chosen, score.words, evidence, tuple(one for _, _, one, _ in every), found, cameras, images)


def thinned(observations: Observations) -> Observations:
    """At most so many images of each pair, evenly over their order."""
    pairs = len(observations.views)
    most = max(MOST_IMAGES // pairs, min(FEWEST_OF_PAIR, MOST_OF_MANY_PAIRS // pairs), FEW)

    def some(view: Views) -> Views:
        number = len(view.A)
        at = np.unique(np.linspace(0, number - 1, min(number, most)).round().astype(np.int64))
        return view.selected(at)

    return replace(observations, views={pair: some(view) for pair, view in observations.views.items()})


def in_words(options: CornerOptions) -> str:
    """What the options assume about A and about sizes."""
    noise = options.carrier_noise
    if isinstance(noise, CarrierNoise):
        of_A = f"A's noise as stated ({np.degrees(noise.rotation_rad):.2g}° and {1e3 * noise.translation_m:.2g} mm)"
    else:
        of_A = "A as exact" if noise == "exact" else "A's noise estimated"
    if not isinstance(options.size_share, Mapping):
        return f"{of_A} and sizes {'estimated' if options.size_share else 'as stated'}"
    free = [name for name, share in options.size_share.items() if share]
    sizes = f"the size of {free[0]} estimated" if len(free) == 1 else "some sizes estimated"
    return f"{of_A} and {sizes if free else 'sizes as stated'}"


#: A growth of standard deviations below this factor is not reported.
SEEN_GROWTH = 1.05


def choices_of(tried: Tried) -> Iterator[Choice]:
    """What is free of cameras and boards, with its rivals; and by how much blocks of images widen the deviations."""
    for what in dict.fromkeys(one.what for one in tried.cameras.tried):
        every = [one for one in tried.cameras.tried if one.what == what]
        chosen = next(one for one in every if one.is_chosen)
        others = [one for one in every if one.is_shared != chosen.is_shared]
        if others and not chosen.is_shared:
            continue  # they are no one camera, and what is free of each is said of it
        rivals = [f"{one.px:.4g} px {one.words}" for one in every if one not in others and one is not chosen]
        if others:
            rivals.append(f"{min(one.px for one in others):.4g} px each camera by itself, at best")
        words = f"one camera for all of them, {chosen.words}" if chosen.is_shared else chosen.words
        evidence = f"the simplest that predicts images that were left out as well as any: {chosen.px:.4g} px"
        yield Choice(what, words, f"{evidence} ({', '.join(rivals)})")
    frames = [(name, factor) for (letter, name), factor in tried.wider.items() if letter in "xy"]
    said = ", ".join(f"{name} {factor:.2g}" for name, factor in frames if factor > SEEN_GROWTH)
    if said:
        evidence = "answers without blocks of images, by time and by pose, scatter by more than corners' errors explain"
        yield Choice("standard deviations", f"widened by these factors: {said}", evidence)


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


#: Intrinsics taken as exact, but wrong by more than this many standard deviations of a calibration, give wrong poses.
SURE_SIGMAS = 5.0


def findings_of(
    observations: Observations, corners: CornersRefined, tried: Tried, intrinsics: Mapping[str, Intrinsics]
) -> Iterator[Finding]:
    """What the corners say against stated intrinsics, and what no model explains."""
    for name, one in intrinsics.items():
        innovation = corners.intrinsics[name].innovation
        if innovation.is_contradicted and one.stated_as != "unknown":  # what nobody stated cannot be wrong
            stated, found = _numbers(one.stated_camera), _numbers(one.camera)
            words = (
                f"the intrinsics of {name}, as stated ({stated}), do not fit its corners ({innovation.deviations:.2g} "
                f"deviations off); the estimated ones ({found}) are used"
            )
            yield Finding(Ground.INTRINSICS_ESTIMATED, words)
        lens = lens_that_was_left_out(corners, [name])
        if lens and one.stated_as == "calibration":
            words = f"the intrinsics of {name} are stated without distortion, and its corners show one: {lens}"
            yield Finding(Ground.INTRINSICS_ESTIMATED, words)
    times = tried.unexplained
    if times > 1.0:
        words = (
            f"images that were left out are predicted to {tried.scores[0].mm:.2g} mm on the target, {times:.2g} times "
            "as far off as the noise of corners and of A explains: the arm's poses, or the target, have systematic "
            "errors, and the standard deviations are widened by as much, or as blocks of images disagree"
        )
        yield Finding(Ground.SYSTEMATIC, words)
    yield from _against_exact(observations, corners, tried.options)


def _against_exact(observations: Observations, corners: CornersRefined, options: CornerOptions) -> Iterator[Finding]:
    """Findings where exact intrinsics would move far if they had a calibration's standard deviations."""
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
                f"the intrinsics of {name} are stated as exact ({_numbers(observations.cameras[name])}), and its "
                f"corners contradict them ({innovation.deviations:.2g} deviations of a calibration off): they tell "
                f"{_numbers(free.intrinsics[name].camera)}"
            )
            yield Finding(Ground.INTRINSICS_DOUBTED if is_sure else Ground.INTRINSICS_UNCERTAIN, words)


def _numbers(camera: Camera) -> str:
    K = np.rint(camera.K).astype(int)
    return f"fx, fy = {K[0, 0]}, {K[1, 1]}; cx, cy = {K[0, 2]}, {K[1, 2]}"
