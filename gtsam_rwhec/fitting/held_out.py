"""How well corners are predicted in images that the calibration has not seen.

Blocks of instants are left out, in the order of each pair's images. Poses and intrinsics are refined from the others,
and predict the left-out corners with the measured A. A refinement that frees the carriers' poses fits its own images to
a tenth of a pixel, whatever is wrong with the arm: its residuals prove nothing, and this error decides.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import gtsam
import numpy as np
from rwhec_factors import se3

from gtsam_rwhec.cameras.camera import Camera
from gtsam_rwhec.errors import CountError, OptionError
from gtsam_rwhec.files.progress import Progress, silent
from gtsam_rwhec.files.terminal_text import brief
from gtsam_rwhec.fitting.corner_refinement import refine_corners
from gtsam_rwhec.fitting.corner_residuals import Stack, stacks_of
from gtsam_rwhec.fitting.corners_refined import CornersRefined
from gtsam_rwhec.fitting.fit_options import CarrierNoise, CornerOptions
from gtsam_rwhec.fitting.observations import Observations, Views
from gtsam_rwhec.geometry.blas_threads import one_blas_thread
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.geometry.real_numbers import is_whole

#: The image is divided into so many columns and rows.
REGIONS = 3


@dataclass(frozen=True, eq=False)
class HeldOut:
    """Errors of a sensor's corners in images that were left out."""

    #: Root mean square length of the error, in pixels, and on the target: pixels by depth over focal length.
    rms_px: float
    rms_mm: float
    corners: int
    #: What the covariances say of `rms_px`: errors that are larger by far show what the model lacks.
    expected_px: float
    #: (3, 3): The same in pixels by region of the image, rows from the top; nan where no corner was seen.
    regions_px: Array


@dataclass(frozen=True, eq=False)
class LeftOut:
    """What leaving images out in blocks shows."""

    #: By sensor.
    errors: dict[str, HeldOut]
    #: By unknown: the scatter of the blocks' estimates (jackknife), divided by that which their covariance predicts.
    spread: dict[tuple[str, str], float]


def held_out_errors(
    observations: Observations,
    refined: CornersRefined,
    options: CornerOptions | None = None,
    *,
    folds: int = 5,
    progress: Progress | None = None,
) -> dict[str, HeldOut]:
    """Errors of corners in images that were left out, by sensor: `left_out` without the spread."""
    return left_out(observations, refined, options, folds=folds, progress=progress).errors


@one_blas_thread()
def left_out(
    observations: Observations,
    refined: CornersRefined,
    options: CornerOptions | None = None,
    *,
    folds: int = 5,
    progress: Progress | None = None,
) -> LeftOut:
    """Leave images out in blocks: their corners' errors, and how much the estimates differ.

    Parameters
    ----------
    observations, options
        Those that `refined` was made from.
    refined : CornersRefined
        Its poses are the start, and its noise of A is given; corners that it left out do not count.
    folds : int
        Blocks of instants that are left out in turns, at least two.

    Raises
    ------
    OptionError
        `folds` is not a whole number of 2 or more.
    CountError
        There are fewer instants than folds; without a block a frame has no image left; or the observations are others.
    """
    options, tell = options or CornerOptions(), progress or silent
    if not is_whole(folds, 2):
        raise OptionError(f"folds={brief(folds)}; give a whole number from 2")
    counted = _without(observations, refined)
    stacks, A = stacks_of(counted)
    if len(A) < folds:
        raise CountError(f"{len(A)} instants cannot be left out in {folds} blocks; give folds={len(A)} or less")
    noise = refined.noise.carrier
    told = replace(options, carrier_noise="exact", outliers=False)
    if noise is not None:
        about = refined.graph.model.about
        told = replace(told, carrier_noise=CarrierNoise(float(noise[0]), float(noise[3]), about=about))
    block = _blocks(stacks, len(A), folds)
    found: dict[str, list[tuple[Array, Array, Array, Array]]] = {name: [] for name in observations.sensors}
    parts = []
    for fold in range(folds):
        tell(f"predicting images that were left out: block {fold + 1} of {folds}")
        rest = _some(counted, stacks, block != fold)
        again = refine_corners(rest, refined.X, refined.Y, told)
        parts.append(again)
        for stack in stacks:
            if (seen := block[stack.instant] == fold).any():
                found[stack.sensor].append(_predicted(stack.selected(seen), A, again))
    errors = {
        name: _of_sensor(
            *(np.concatenate(values) for values in zip(*each, strict=True)), camera=observations.cameras[name]
        )
        for name, each in found.items()
    }
    return LeftOut(errors, spread_over_claims(refined, parts))


def _predicted(stack: Stack, A: Array, refined: CornersRefined) -> tuple[Array, Array, Array, Array]:
    """Lengths of a stack's errors (m,), in pixels and on the target, m; the squares that are expected; and the pixels.

    The measured A of the stack's instants predicts them. A corner's square is expected to be the traces of its noise,
    of the unknowns' covariance, and of A's noise.
    """
    model, known = refined.graph.model, stack.known
    camera = refined.intrinsics[stack.sensor].camera
    seen, point = replace(stack, camera=camera), replace(refined.point, A=A)
    rows = model.linearised(seen, point)
    length = np.linalg.norm(rows.residual.reshape(*known.shape, 2), axis=2)[known]
    on_target = length * model.seen(seen, point).z[known] / camera.focal_px
    blocks = {
        ("x", stack.target): rows.by_X,
        ("y", stack.sensor): rows.by_Y,
        ("k", model.camera_of[stack.sensor]): rows.by_camera,
        ("b", stack.target): rows.by_shape,
        ("t", stack.sensor): rows.by_time,
    }
    there = {name: block for name, block in blocks.items() if name in refined.slots}
    J = np.concatenate(list(there.values()), axis=2)
    index = np.concatenate([np.arange(refined.slots[name].start, refined.slots[name].stop) for name in there])
    squares = np.einsum("vri,ij,vrj->vr", J, refined.joint[np.ix_(index, index)], J, optimize=True)
    if ("p", stack.target) in refined.slots:  # each corner's own place, which the target's pose goes with
        at, n, by_corners = refined.slots["p", stack.target], known.shape[1], rows.by_corners
        own = refined.joint[at, at].reshape(n, 3, n, 3)[range(n), :, range(n)]
        mixed = refined.joint[index, at].reshape(-1, n, 3)
        of_corner = np.einsum("vnri,nij,vnrj->vnr", by_corners, own, by_corners, optimize=True)
        J_of_corner = J.reshape(*by_corners.shape[:3], -1)
        of_corner += 2.0 * np.einsum("vnrm,mni,vnri->vnr", J_of_corner, mixed, by_corners, optimize=True)
        squares += of_corner.reshape(squares.shape)
    noise = refined.noise.carrier
    if noise is not None:
        by_A = rows.by_A
        if model.about == "sensorcarrier":
            by_A = by_A @ se3.adjoint(se3.inverse(A))[stack.instant]
        squares += np.einsum("vri,i->vr", by_A**2, noise**2)
    expected = 2.0 * refined.noise.corner_px**2 + squares.reshape(*known.shape, 2).sum(axis=2)[known]
    return length, on_target, expected, stack.pixels[known]


def _blocks(stacks: tuple[Stack, ...], instants: int, folds: int) -> np.ndarray:
    """The block (I,) of each instant: by its place among the images of the pairs that it is in, so that each block has
    a part of every pair."""
    place, count = np.zeros(instants), np.zeros(instants)
    for stack in stacks:
        number = len(stack.instant)
        np.add.at(place, stack.instant, (np.arange(number) + 0.5) / number)
        np.add.at(count, stack.instant, 1.0)
    return np.minimum((folds * place / count).astype(np.int64), folds - 1)


def rms_by_region(camera: Camera, pixels: Array, values: Array) -> Array:
    """Root mean squares (3, 3) of values (n,) at pixels (n, 2) by region of the image; nan where there are none."""
    size = np.array([camera.width, camera.height])
    at = np.clip((REGIONS * (pixels + 0.5) / size).astype(int), 0, REGIONS - 1) @ [1, REGIONS]
    count, total = np.bincount(at, minlength=REGIONS**2), np.bincount(at, values**2, REGIONS**2)
    return np.sqrt(np.where(count > 0, total / np.maximum(count, 1), np.nan)).reshape(REGIONS, REGIONS)


def _of_sensor(length: Array, on_target: Array, expected: Array, pixels: Array, *, camera: Camera) -> HeldOut:
    return HeldOut(
        float(np.sqrt((length**2).mean())),
        float(1e3 * np.sqrt((on_target**2).mean())),
        len(length),
        float(np.sqrt(expected.mean())),
        rms_by_region(camera, pixels, length),
    )


def _without(observations: Observations, refined: CornersRefined) -> Observations:
    """The observations without the corners that were left out."""
    for pair, view in observations.views.items():
        if pair not in refined.left_out or refined.left_out[pair].shape != view.pixels.shape[:2]:
            raise CountError(
                f"the images of {pair[0]} by {pair[1]} are not those that the refinement is from; give its observations"
            )
    views = {
        pair: replace(view, pixels=np.where(refined.left_out[pair][..., None], np.nan, view.pixels))
        for pair, view in observations.views.items()
    }
    return replace(observations, views=views)


def _some(observations: Observations, stacks: tuple[Stack, ...], instants: np.ndarray) -> Observations:
    """The images of some instants; `CountError` if a frame has none left."""
    views: dict[tuple[str, str], Views] = {}
    for stack in stacks:
        kept = instants[stack.instant]
        if kept.any():
            views[stack.target, stack.sensor] = observations.views[stack.target, stack.sensor].selected(kept)
    some = replace(observations, views=views)
    for what, every, left in (
        ("target", observations.targets, some.targets), ("sensor", observations.sensors, some.sensors),
    ):  # fmt: skip
        gone = [name for name in every if name not in left]
        if gone:
            raise CountError(f"{what} {gone[0]} has all its images in one block; give more folds")
    return some


def spread_over_claims(refined: CornersRefined, parts: Sequence[CornersRefined]) -> dict[tuple[str, str], float]:
    """By unknown: the jackknife's deviation over the claimed one, root mean square of its numbers.

    Parameters
    ----------
    refined : CornersRefined
        From all images.
    parts : sequence of CornersRefined
        From all but one block each.
    """
    m = len(parts)
    found = {}
    for slot, rows in refined.slots.items():
        off = np.array([_off(refined, part, slot) for part in parts])
        variances = (m - 1) / m * ((off - off.mean(axis=0)) ** 2).sum(axis=0)
        found[slot] = float(np.sqrt((variances / np.diagonal(refined.joint)[rows]).mean()))
    return found


def _off(refined: CornersRefined, part: CornersRefined, slot: tuple[str, str]) -> Array:
    """How far a part's unknown is from that of all images."""
    letter, name = slot
    if letter in "xy":
        first, second = (each.X if letter == "x" else each.Y for each in (refined, part))
        moved: Array = gtsam.Pose3.Logmap(first[name].between(second[name]))
        return moved
    vectors = refined.graph.model.vectors
    return vectors(part.point)[slot] - vectors(refined.point)[slot]
