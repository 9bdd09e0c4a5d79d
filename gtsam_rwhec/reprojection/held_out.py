"""How well corners are predicted in images that the calibration has not seen.

Instants are left out in blocks, each pair's images in their order; poses and intrinsics are refined from the others,
and predict the corners by the measured A. A refinement that frees the carriers' poses fits its own images
to a tenth of a pixel, whatever is wrong with the arm: its residuals prove nothing, and this error decides.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from gtsam_rwhec.errors import CountError, OptionError
from gtsam_rwhec.files.progress import Progress, silent
from gtsam_rwhec.files.terminal_text import brief
from gtsam_rwhec.geometry.blas_threads import one_blas_thread
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.geometry.real_numbers import is_whole
from gtsam_rwhec.refinement.options import CarrierNoise
from gtsam_rwhec.reprojection.corner_views import Stack, depths, pixel_errors, stacks_of
from gtsam_rwhec.reprojection.lens import parameters_of
from gtsam_rwhec.reprojection.observations import Observations, Views
from gtsam_rwhec.reprojection.options import CornerOptions
from gtsam_rwhec.reprojection.refined import CornersRefined
from gtsam_rwhec.reprojection.refining_corners import refine_corners
from gtsam_rwhec.vision.camera import Camera

#: The image is divided into so many columns and rows.
REGIONS = 3


@dataclass(frozen=True, eq=False)
class HeldOut:
    """Errors of a sensor's corners in images that were left out.

    Attributes
    ----------
    rms_px, rms_mm : float
        Root mean square length of the error, in pixels, and on the target: pixels by depth over focal length.
    corners : int
    regions_px : (3, 3) array
        The same in pixels by region of the image, rows from the top; nan where no corner was seen.
    """

    rms_px: float
    rms_mm: float
    corners: int
    regions_px: Array


@one_blas_thread()
def held_out_errors(
    observations: Observations,
    refined: CornersRefined,
    options: CornerOptions | None = None,
    *,
    folds: int = 5,
    progress: Progress | None = None,
) -> dict[str, HeldOut]:
    """Errors of corners in images that were left out, by sensor.

    Parameters
    ----------
    observations, options
        Those that `refined` was made from.
    refined : CornersRefined
        Its poses are the start, and its noise of A is given; corners that it left out do not count.
    folds : int
        Blocks of instants that are left out in turns, at least two.
    progress : callable, optional

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
    found: dict[str, list[tuple[Array, Array, Array]]] = {name: [] for name in observations.sensors}
    for fold in range(folds):
        tell(f"predicting images that were left out: block {fold + 1} of {folds}")
        rest = _some(counted, stacks, block != fold)
        again = refine_corners(rest, refined.X, refined.Y, told)
        for stack in _some_stacks(stacks, block == fold):
            X, Y = again.X[stack.target].matrix(), again.Y[stack.sensor].matrix()
            camera = again.intrinsics[stack.sensor].camera
            shape = again.shapes[stack.target]
            off = again.time_offsets_s.get(stack.sensor, 0.0), again.point.corners.get(stack.target)
            seen = replace(stack, camera=camera)
            errors = pixel_errors(seen, X, Y, A, parameters_of(camera), shape, *off).reshape(*stack.known.shape, 2)
            length = np.linalg.norm(errors, axis=2)[stack.known]
            on_target = length * depths(stack, X, Y, A, shape, *off)[stack.known] / camera.focal_px
            found[stack.sensor].append((length, on_target, stack.pixels[stack.known]))
    return {
        name: _of_sensor(
            np.concatenate([length for length, _, _ in each]),
            np.concatenate([on_target for _, on_target, _ in each]),
            np.concatenate([pixels for _, _, pixels in each]),
            observations.cameras[name],
        )
        for name, each in found.items()
    }


def _blocks(stacks: tuple[Stack, ...], instants: int, folds: int) -> np.ndarray:
    """The block (I,) of each instant: by its place among the images of the pairs that it is in, so that each block has
    a part of every pair."""
    place, count = np.zeros(instants), np.zeros(instants)
    for stack in stacks:
        number = len(stack.instant)
        np.add.at(place, stack.instant, (np.arange(number) + 0.5) / number)
        np.add.at(count, stack.instant, 1.0)
    return np.minimum((folds * place / count).astype(np.int64), folds - 1)


def _of_sensor(length: Array, on_target: Array, pixels: Array, camera: Camera) -> HeldOut:
    size = np.array([camera.width, camera.height])
    at = np.clip((REGIONS * (pixels + 0.5) / size).astype(int), 0, REGIONS - 1)
    count, total = np.zeros((REGIONS, REGIONS)), np.zeros((REGIONS, REGIONS))
    np.add.at(count, (at[:, 1], at[:, 0]), 1.0)
    np.add.at(total, (at[:, 1], at[:, 0]), length**2)
    regions = np.full((REGIONS, REGIONS), np.nan)
    regions[count > 0] = np.sqrt(total[count > 0] / count[count > 0])
    return HeldOut(
        float(np.sqrt((length**2).mean())), float(1e3 * np.sqrt((on_target**2).mean())), len(length), regions
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


def _some_stacks(stacks: tuple[Stack, ...], instants: np.ndarray) -> list[Stack]:
    return [stack.selected(kept) for stack in stacks if (kept := instants[stack.instant]).any()]
