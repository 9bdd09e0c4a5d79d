"""Lens models without a ray for a corner that was seen: they fold back nearer to the centre than the corner is."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import numpy as np

from gtsam_rwhec.errors import CameraError
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.problem.pairs import Pair
from gtsam_rwhec.reprojection.corner_views import Stack
from gtsam_rwhec.reprojection.observations import Observations
from gtsam_rwhec.reprojection.options import CornerOptions
from gtsam_rwhec.reprojection.refined import CornersRefined
from gtsam_rwhec.vision.camera import Camera

#: Corners that are left out count where they are more than this share: a single one may be misread.
SHARE = 0.01

CURE = (
    "check D, its order and its model, state another one (k3 or the rational model, equidistant, unified), or leave "
    "such corners out (nan)"
)


def check_rays(stacks: tuple[Stack, ...], options: CornerOptions) -> None:
    """CameraError where intrinsics that are held as stated have no ray for a corner."""
    for stack in stacks:
        words = without_rays(stack.camera, _seen(stack), stack.known)
        if words and options.stated_of(options.camera_of(stack.sensor)) == "exact":
            raise CameraError(f"the intrinsics of {stack.sensor} are held as stated (exact), but {words}; {CURE}")


def findings_of_rays(refined: CornersRefined) -> Iterator[str]:
    """Sentences about lens models that have no rays for corners: the estimated ones, and those that were stated."""
    model = refined.graph.model
    for stack, weights in zip(model.stacks, model.weights, strict=True):
        counted = stack.known & (weights > 0.0)
        camera = refined.intrinsics[stack.sensor].camera
        now = without_rays(camera, _seen(stack), counted, model.off_axis(stack, refined.point) >= camera.ring)
        before = without_rays(stack.camera, _seen(stack), counted)
        if now:
            yield f"As estimated, {now}: do not use these intrinsics there, and doubt this answer; {CURE}."
        elif before:
            yield f"As stated, {before}. The estimated one has rays there: {CURE}."


def findings_of_images_left_out(observations: Observations, inliers: Mapping[Pair, np.ndarray]) -> Iterator[str]:
    """Sentences about images that are left out, where the stated lens model has no rays for corners of theirs."""
    for (target, sensor), view in observations.views.items():
        kept = inliers[Pair(target, sensor)][:, None, None]
        pixels = np.where(kept, np.nan, view.pixels)
        words = without_rays(observations.cameras[sensor], (target, sensor, pixels), view.known)
        if words:
            yield f"Images of {sensor} are left out, in which, as stated, {words}. {CURE[0].upper()}{CURE[1:]}."


def _seen(stack: Stack) -> tuple[str, str, Array]:
    return stack.target, stack.sensor, np.where(stack.known[..., None], stack.pixels, np.nan)


def without_rays(
    camera: Camera, seen: tuple[str, str, Array], counted: np.ndarray, beyond: np.ndarray | None = None
) -> str:
    """Which corners of a target by a sensor (V, n, 2) a camera has no ray for, in words.

    Empty where there are none that count (V, n), and hardly others. Corners that poses put `beyond` the fold (V, n)
    have none either, though the polynomial leads back to their pixel.
    """
    target, sensor, pixels = seen
    known = np.asarray(np.isfinite(pixels).all(axis=2))
    dark = ~camera.has_ray(pixels) if beyond is None else ~camera.has_ray(pixels) | (beyond & known)
    if not (dark & counted).any() and dark.sum() <= SHARE * known.sum():
        return ""
    return (
        f"the lens model of {sensor} ({camera.model}) has no ray for {dark.sum()} of {known.sum()} corners of {target} "
        f"({first_of(dark, pixels)}): {ends(camera)}"
    )


def first_of(dark: np.ndarray, pixels: Array) -> str:
    """The first of some corners (V, n) at pixels (V, n, 2)."""
    image, corner = np.argwhere(dark)[0]
    x, y = pixels[image, corner]
    return f"the first is corner {corner} of image {image}, at ({x:.1f}, {y:.1f})"


def ends(camera: Camera) -> str:
    """How far a camera's rays go."""
    if not np.isfinite(camera.ring) and camera.model == "radtan":
        return "its distortion folds back there"
    what = "its distortion folds back" if np.isfinite(camera.ring) else "its rays in front of the camera end"
    return f"{what} {camera.reach_px:.0f} pixels from the centre"
