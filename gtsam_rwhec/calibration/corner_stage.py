"""The stage that refines from corners: which model of A and of sizes predicts images best, and what comes out.

Poses of boards come first: they give the certified start, the outliers among images, the noise in time and over the
configuration. The corners then give the answer, with the cameras' intrinsics as variables.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from gtsam_rwhec.calibration.choices import Choice
from gtsam_rwhec.calibration.corner_choice import Tried, chosen_model, thinned
from gtsam_rwhec.calibration.verdict import Finding, Ground
from gtsam_rwhec.errors import CameraError, OutlierError, RwhecError, UnderdeterminedError
from gtsam_rwhec.files.progress import Progress
from gtsam_rwhec.fitting.corner_findings import DETECTOR_PX, is_doubtful, lens_that_was_left_out
from gtsam_rwhec.fitting.corner_refinement import refine_corners
from gtsam_rwhec.fitting.corners_as_refined import as_refined, intrinsics_of, numbers_of
from gtsam_rwhec.fitting.corners_refined import CornersRefined
from gtsam_rwhec.fitting.fit_options import CornerOptions
from gtsam_rwhec.fitting.noise_in_data import NoiseInData
from gtsam_rwhec.fitting.observations import Observations
from gtsam_rwhec.fitting.refined import Refined
from gtsam_rwhec.fitting.refinement import beyond_independent_errors
from gtsam_rwhec.fitting.reprojection_record import Intrinsics, Reprojection, TriedModel
from gtsam_rwhec.geometry.poses import PoseLike

#: What is chosen: the measurements that the answer is from.
MEASUREMENTS = "refinement"
#: Standard deviation of a size that is estimated, a share of 1.
SIZE_SHARE = 0.2
#: A growth of standard deviations below this is not said.
SEEN_GROWTH = 1.05
#: Images that were left out are off by more than this times what covariances say, where the model lacks something.
UNEXPLAINED = 1.5
#: Exact intrinsics that are off by more deviations of a calibration than this make wrong poses.
SURE = 5.0


@dataclass(frozen=True, eq=False)
class CornersFound:
    """What the corners gave.

    Attributes
    ----------
    corners : CornersRefined or None
        None where they give no better answer than the poses.
    intrinsics : dict of str to Intrinsics
    reprojection : Reprojection or None
    choices : tuple of Choice
    findings : tuple of Finding
    wider : dict of (letter, name) to float
        By how much each unknown's deviations are widened, since images that were left out are farther off than the
        covariances say; empty where they are not.
    """

    corners: CornersRefined | None
    intrinsics: dict[str, Intrinsics]
    reprojection: Reprojection | None
    choices: tuple[Choice, ...]
    findings: tuple[Finding, ...]
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
) -> CornersFound:
    """Refine from corners under the options, or with A as exact where that predicts images better.

    Parameters
    ----------
    X, Y : dict of str to pose
        The start: the answer from the poses of the same images.
    observations : Observations
    options : CornerOptions
    tell : callable
    """
    try:
        tried = chosen_model(observations, X, Y, options, tell)
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
        numbers_of(observations, corners, tried.options, tried.left_out.errors, _tried(tried)),
        tuple(_choices(observations, corners, tried, intrinsics)),
        (*_findings(corners, tried, intrinsics), *_against_exact(observations, corners, tried.options)),
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
            is_sure = innovation.deviations > SURE
            words = (
                f"the intrinsics of {name} count as exact, as an option says, and its corners contradict them "
                f"({innovation.deviations:.2g} deviations of a calibration off)"
            )
            yield Finding(Ground.INTRINSICS_DOUBTED if is_sure else Ground.INTRINSICS_UNCERTAIN, words)


def _tried(tried: Tried) -> tuple[TriedModel, ...]:
    """The models in numbers; without those that put a target behind its camera."""
    best = tried.scores[:1]
    return tuple(TriedModel(one.words, one.px, one.mm, one in best) for one in tried.scores if np.isfinite(one.px))


def _choices(
    observations: Observations, corners: CornersRefined, tried: Tried, intrinsics: Mapping[str, Intrinsics]
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


def _findings(corners: CornersRefined, tried: Tried, intrinsics: Mapping[str, Intrinsics]) -> Iterator[Finding]:
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
