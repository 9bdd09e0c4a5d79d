"""Whether corners determine all poses: there is one optimum, the corners are near it, and every deviation is small."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace

import numpy as np
from rwhec_factors import se3

from gtsam_rwhec.cameras.camera import Camera
from gtsam_rwhec.errors import CameraError, CountError, FrameError, OptionError, OutlierError, UnderdeterminedError
from gtsam_rwhec.files.terminal_text import brief, counted
from gtsam_rwhec.fitting.corner_model import Model, Point
from gtsam_rwhec.fitting.corner_noise import Noise, Reduced, errors_px
from gtsam_rwhec.fitting.corner_residuals import Stack
from gtsam_rwhec.fitting.corners_refined import CornersRefined
from gtsam_rwhec.fitting.fit_options import CornerOptions
from gtsam_rwhec.fitting.observations import Observations
from gtsam_rwhec.fitting.stated_intrinsics import CENTRE_PX
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.problem.measurements import Pair

#: Corners whose median error is above this, pixels, do not belong to the poses.
FARTHEST_PX = 30.0
#: Corners of an image that lie closer together, pixels, have no shape.
ONE_PLACE_PX = 1.0
#: A frame with a larger deviation is not determined: rad, and times the largest distance of a corner from its camera.
ROTATION_RAD, TRANSLATION_OF_DISTANCE = 0.5, 10.0

CURE = (
    "take more images, in which the carriers turn about two axes that are not parallel, by 30 degrees and more, and "
    "give each image the pose A of its own instant"
)


def check_arguments(observations: object, options: object) -> None:
    """OptionError for what is neither observations nor options."""
    if not isinstance(observations, Observations):
        raise OptionError(
            f"observations={brief(observations)} are not Observations; make them by rw.Observations.of(cameras, "
            "corners, views)"
        )
    if options is not None and not isinstance(options, CornerOptions):
        raise OptionError(f"options={brief(options)} are not CornerOptions; give rw.CornerOptions(...), or None")


def check_options(options: CornerOptions, observations: Observations) -> None:
    """FrameError where options name an unknown frame; CameraError where two cameras cannot share intrinsics.

    Without this check, a misspelt name would silently leave intrinsics nominal, or a size as stated.
    """
    sensors = observations.sensors
    every = [name for group in options.shared for name in group]
    strange = [name for name in every if name not in sensors]
    if strange:
        raise FrameError(f"CornerOptions.shared names {strange[0]!r}; the sensors are {', '.join(sensors)}")
    twice = [name for i, name in enumerate(every) if name in every[:i]]
    if twice:
        raise FrameError(f"CornerOptions.shared names {twice[0]!r} twice; a sensor is in one group")
    for name in every:
        camera, first = (observations.cameras[each] for each in (name, options.camera_of(name)))
        sizes = [f"{each.width} x {each.height}" for each in (camera, first)]
        if sizes[0] != sizes[1]:
            raise CameraError(
                f"CornerOptions.shared says that {name} has the intrinsics of {options.camera_of(name)}, but its "
                f"images have {sizes[0]} pixels, and those of the other {sizes[1]}; leave it out of the group"
            )
    for words, given, known, what in (
        ("stated", options.stated, observations.cameras, "sensors"),
        ("lens", options.lens, observations.cameras, "sensors"),
        ("size_share", options.size_share, observations.corners, "targets"),
        ("warp_m", options.warp_m, observations.corners, "targets"),
    ):
        strange = [name for name in given if name not in known] if isinstance(given, Mapping) else []
        if strange:
            raise FrameError(f"CornerOptions.{words} names {strange[0]!r}; the {what} are {', '.join(known)}")


def check_clocks(options: CornerOptions, observations: Observations) -> None:
    """FrameError where a time offset is asked of a sensor without images; CountError where velocities are missing."""
    for name in options.time_offsets:
        if name not in observations.sensors:
            raise FrameError(
                f"CornerOptions.time_offsets names {name!r}; the sensors are {', '.join(observations.sensors)}"
            )
        lacking = [pair[0] for pair, view in observations.views.items() if pair[1] == name and view.twist is None]
        if lacking:
            raise CountError(
                f"the time offset of {name} needs the carriers' velocity at each of its images, and those of "
                f"{', '.join(lacking)} have none: give views as (A, pixels, twist), with twist (N, 6) [omega rad/s, v "
                f"m/s] in the target carrier's axes; or leave {name} out of CornerOptions.time_offsets"
            )


def check_names(start: object, names: tuple[str, ...], *, letter: str) -> None:
    """FrameError where a start X or Y lacks a target or sensor of the images; OptionError where it is no dict."""
    what, pose = {"X": ("target", "T_targetcarrier_target"), "Y": ("sensor", "T_sensorcarrier_sensor")}[letter]
    if not isinstance(start, Mapping):
        raise OptionError(f"{letter}={brief(start)} is not a dict; give {pose} of each {what} by its name")
    missing = [name for name in names if name not in start]
    if missing:
        there = f"it has {', '.join(map(str, start))}" if start else "it is empty"
        raise FrameError(
            f"the start {letter} lacks the {what} {', '.join(missing)} ({there}); give {pose} of each {what}, such as "
            "the certified answer's, or call rw.calibrate_corners, which needs no start"
        )


@contextmanager
def told_where_it_fails(model: Model, point: Point) -> Iterator[None]:
    """Linear systems without one solution become OutlierError or UnderdeterminedError."""
    try:
        with np.errstate(all="ignore"):
            yield
    except (RuntimeError, np.linalg.LinAlgError) as error:
        if isinstance(error, RuntimeError) and "indetermina" not in str(error).lower():
            raise
        check_corners(model, point)
        raise UnderdeterminedError(
            f"the images do not determine {_frames(model)}: {_what_there_is(model)} leave their poses free; {CURE}"
        ) from error


def check_corners(model: Model, point: Point) -> None:
    """OutlierError where half of the corners or more are far from where the poses put them."""
    for stack, error in zip(model.stacks, errors_px(model, point), strict=True):
        for (target, sensor), at in stack.pairs:
            median = float(np.median(error[at][stack.known[at]]))
            if not median < FARTHEST_PX:
                raise OutlierError(
                    f"the corners of {target} in the images of {sensor} do not belong to the poses: half of them are "
                    f"off by {min(median, 1e5):.0f} pixels or more ({_what_there_is(model)}); check that each image "
                    "has the pose A of its own instant, that corners have the target's order, and that A, the start "
                    "and the sizes are in metres"
                )


def check_determined(
    model: Model, start: Point, point: Point, joint: Array, slots: Mapping[tuple[str, str], slice]
) -> None:
    """UnderdeterminedError where a frame's standard deviation is infinite or too large: images do not determine it."""
    distance = min(farthest(model, start), farthest(model, point))
    limits = ROTATION_RAD, TRANSLATION_OF_DISTANCE * distance
    faults = []
    for (letter, name), at in slots.items():
        if letter not in "xy":
            continue
        block = joint[at, at]
        if not (np.isfinite(block).all() and (np.diagonal(block) > 0.0).all()):
            faults.append(f"{name} (no finite deviation)")
            continue
        rotation, translation = (
            float(np.sqrt(max(np.linalg.eigvalsh(part)[-1], 0.0))) for part in (block[:3, :3], block[3:, 3:])
        )
        if rotation > limits[0] or translation > limits[1]:
            faults.append(f"{name} (deviation {np.degrees(rotation):.3g} degrees, {translation:.3g} m)")
    if faults:
        alike = ""
        if model.offset_priors:
            clocks = ", ".join(model.offset_priors)
            alike = f". Or leave {clocks} out of time_offsets: motion that is alike in all images hides them"
        raise UnderdeterminedError(
            f"the images do not determine the pose of {', '.join(faults)}: {_what_there_is(model)} are too few or too "
            f"much alike; {CURE}{alike}"
        )
    if not (np.isfinite(joint).all() and (np.diagonal(joint) > 0.0).all()):
        words = {"k": "intrinsics", "b": "shape", "t": "time offset", "p": "corners"}
        names = [
            f"{words[letter]} of {name}"
            for (letter, name), at in slots.items()
            if letter in words and not (np.diagonal(joint)[at] > 0.0).all()
        ]
        raise UnderdeterminedError(
            f"the images do not determine the {', the '.join(names) or 'unknowns together'}; state intrinsics "
            f"(CornerOptions.stated) and sizes, or {CURE}"
        )


def farthest(model: Model, point: Point) -> float:
    """The largest depth of a corner that was seen, metres."""
    return max(float(model.seen(stack, point).z[stack.known].max()) for stack in model.stacks)


def _frames(model: Model) -> str:
    return ", ".join((*model.targets, *model.sensors))


def _what_there_is(model: Model) -> str:
    """How many images at how many different poses."""
    images = sum(len(stack.instant) for stack in model.stacks)
    poses = len(model.A)
    at = "one pose" if poses == 1 else f"{poses} different poses"
    few = few_corners(model)
    return f"{counted(images, 'image')} at {at} of the carriers{few and f' ({few})'}"


def few_corners(model: Model) -> str:
    """A sentence if the corners give no more equations than there are unknowns; else empty."""
    numbers = 2 * sum(int(stack.known.sum()) for stack in model.stacks)
    cameras = sum(len(prior.mean) for prior in model.camera_priors.values() if prior.deviation[2] > CENTRE_PX["exact"])
    boards = sum(len(model.free_shape(name)) for name in model.targets)
    of = {target: 3 * stack.points.shape[1] for stack in model.stacks for target in stack.targets}
    corners = sum(number for name, number in of.items() if name in model.corner_priors)
    unknowns = 6 * (len(model.targets) + len(model.sensors)) + cameras + boards + corners
    unknowns += len(model.offset_priors)
    return "" if numbers > unknowns else f"{numbers} coordinates of corners for {unknowns} unknowns"


#: Number of random draws of the noise.
DRAWS = 6
#: Added noise doubles the information that comes from noise alone. If a frame's information grows by more than this
#: factor, a fourth of it or more comes from noise.
GROWS = 1.25
#: Frames with a smaller deviation (rad, and a share of the corners' distance) are determined by motion: noise alone
#: does not give so much.
SMALL = 3e-3


def grows_by_noise(
    model: Model, point: Point, noise: Noise, joint: Array, slots: Mapping[tuple[str, str], slice], distance_m: float
) -> dict[str, float]:
    """The factor by which noise of A increases the information on each frame's least known direction; 1: none.

    Only frames with large deviations are tested. `joint` is the covariance (d, d) of the unknowns in `slots`.
    """
    scale = np.repeat([1.0, 1.0 / distance_m], 3)
    weakest = {}
    for (letter, name), at in slots.items():
        if letter in "xy":
            values, vectors = np.linalg.eigh(joint[at, at] * scale[:, None] * scale)
            if values[-1] > SMALL**2:
                weakest[name] = at, vectors[:, -1] * scale
    if model.A_noise is None or not weakest:
        return {}
    rng = np.random.default_rng(0)
    points = [point]
    for _ in range(DRAWS):
        xi = (model.to_right @ (rng.normal(size=(len(model.A), 6)) * model.A_noise)[..., None])[..., 0]
        points.append(replace(point, A=point.A @ se3.expmap(xi)))
    rows = np.array([np.arange(at.start, at.stop) for at, _ in weakest.values()])
    u = np.array([direction for _, direction in weakest.values()])
    covariances = [Reduced.of(model, one).joint(noise)[1].at(rows, rows) for one in points]
    now, *more = (1.0 / np.einsum("ni,nij,nj->n", u, covariance, u) for covariance in covariances)
    return dict(zip(weakest, (np.mean(more, axis=0) / now).tolist(), strict=True))


def check_motion(
    model: Model, point: Point, noise: Noise, joint: Array, slots: Mapping[tuple[str, str], slice], distance_m: float
) -> None:
    """UnderdeterminedError where a frame's pose is determined by noise of A alone."""
    with told_where_it_fails(model, point):
        grows = grows_by_noise(model, point, noise, joint, slots, distance_m)
    faults = [name for name, factor in grows.items() if factor > GROWS]
    if faults:
        raise UnderdeterminedError(
            f"the carriers' motion does not determine the pose of {', '.join(faults)}: what the images say of it comes "
            f"from the noise of A ({np.degrees(noise.carrier_rad):.2g} degrees and {1e3 * noise.carrier_m:.2g} mm), "
            f"which passes for motion; {CURE}"
        )


#: Corners without a ray that are left out count only above this share of all: a single one may be misread.
SHARE = 0.01

LENS_CURE = (
    "check D, its order and its model, state another one (k3 or the rational model, equidistant, unified), or leave "
    "such corners out (nan)"
)


def check_spread(stacks: tuple[Stack, ...]) -> None:
    """UnderdeterminedError where in every image of a sensor all corners of a target are on one pixel."""
    faults = []
    for stack in stacks:
        seen = np.where(stack.known[..., None], stack.pixels, np.nan)
        largest = np.maximum.reduceat((np.nanmax(seen, axis=1) - np.nanmin(seen, axis=1)).max(axis=1), stack.first)
        faults += [f"{stack.sensor} to {stack.targets[t]}" for t in np.flatnonzero(largest < ONE_PLACE_PX)]
    if faults:
        raise UnderdeterminedError(
            f"the images do not determine the pose of {', '.join(faults)}: in each image all corners are within "
            f"{ONE_PLACE_PX:g} pixel; give the corners that were measured, in the target's order"
        )


def check_rays(stacks: tuple[Stack, ...], options: CornerOptions) -> None:
    """Raise CameraError if intrinsics held as stated have no ray for a corner."""
    for stack in stacks:
        if options.stated_of(options.camera_of(stack.sensor)) == "exact":
            for _, words in _without_rays(stack.camera, stack, stack.known):
                what = f"the intrinsics of {stack.sensor} are held as stated (exact), but {words}; {LENS_CURE}"
                raise CameraError(what)


def findings_of_rays(refined: CornersRefined) -> Iterator[str]:
    """Sentences about lens models that have no rays for corners: the estimated ones, and those that were stated."""
    model = refined.graph.model
    for stack, weights in zip(model.stacks, model.weights, strict=True):
        counted = stack.known & (weights > 0.0)
        camera = refined.intrinsics[stack.sensor].camera
        beyond = model.seen(stack, refined.point).radius >= camera.ring
        now = dict(_without_rays(camera, stack, counted, beyond))
        before = dict(_without_rays(stack.camera, stack, counted))
        for target in stack.targets:
            if target in now:
                what = f"As estimated, {now[target]}: do not use these intrinsics there, and doubt this answer"
                yield f"{what}; {LENS_CURE}."
            elif target in before:
                yield f"As stated, {before[target]}. The estimated one has rays there: {LENS_CURE}."


def findings_of_images_left_out(observations: Observations, inliers: Mapping[Pair, np.ndarray]) -> Iterator[str]:
    """Sentences about images that are left out, where the stated lens model has no rays for corners of theirs."""
    for (target, sensor), view in observations.views.items():
        kept = inliers[Pair(target, sensor)][:, None, None]
        pixels = np.where(kept, np.nan, view.pixels)
        words = without_rays(observations.cameras[sensor], (target, sensor, pixels), view.known)
        if words:
            yield f"Images of {sensor} are left out, in which, as stated, {words}. {LENS_CURE.capitalize()}."


def _without_rays(
    camera: Camera, stack: Stack, counted: np.ndarray, beyond: np.ndarray | None = None
) -> Iterator[tuple[str, str]]:
    """`without_rays` of each target of a stack that has such corners, in words."""
    pixels = np.where(stack.known[..., None], stack.pixels, np.nan)
    if camera.has_ray(pixels[stack.known]).all() and (beyond is None or not beyond.any()):
        return
    for pair, at in stack.pairs:
        if words := without_rays(camera, (*pair, pixels[at]), counted[at], None if beyond is None else beyond[at]):
            yield pair[0], words


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
