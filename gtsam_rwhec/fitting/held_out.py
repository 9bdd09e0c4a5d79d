"""How well corners are predicted in images that the calibration has not seen.

Blocks of instants are left out, in the order of each pair's images. Poses and intrinsics are refined from the others,
and predict the left-out corners with the measured A. A refinement that frees the carriers' poses fits its own images to
a tenth of a pixel, whatever is wrong with the arm: its residuals prove nothing, and this error decides.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import gtsam
import numpy as np
from rwhec_factors import se3

from gtsam_rwhec.cameras.camera import Camera
from gtsam_rwhec.errors import CountError, OptionError
from gtsam_rwhec.files.progress import Progress, silent
from gtsam_rwhec.files.terminal_text import brief
from gtsam_rwhec.fitting.corner_checks import check_determined, told_where_it_fails
from gtsam_rwhec.fitting.corner_patterns import OF_AN_IMAGE, patterns
from gtsam_rwhec.fitting.corner_refinement import optimum
from gtsam_rwhec.fitting.corner_residuals import Stack
from gtsam_rwhec.fitting.corners_refined import CornersRefined
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


@one_blas_thread()
def held_out_errors(refined: CornersRefined, *, folds: int = 5, progress: Progress | None = None) -> dict[str, HeldOut]:
    """Errors of corners in images that were left out in blocks, by sensor.

    Parameters
    ----------
    refined : CornersRefined
        From all images. It is the start; its noise and its priors hold for each part, and corners that it left out do
        not count.
    folds : int
        Blocks of instants that are left out in turns, at least two.

    Raises
    ------
    OptionError
        `folds` is not a whole number of 2 or more.
    CountError
        There are fewer instants than folds, or without a block a frame has no image left.
    UnderdeterminedError
        Without a block the images leave a frame's pose free.
    """
    tell = progress or silent
    if not is_whole(folds, 2):
        raise OptionError(f"folds={brief(folds)}; give a whole number from 2")
    model = refined.graph.model
    if len(model.A) < folds:
        raise CountError(
            f"{len(model.A)} instants cannot be left out in {folds} blocks; give folds={len(model.A)} or less"
        )
    stacks = tuple(
        replace(stack, known=stack.known & (weights > 0.0))
        for stack, weights in zip(model.stacks, model.weights, strict=True)
    )
    block = blocks_of(stacks, len(model.A), folds)
    found: dict[str, list[tuple[Array, Array, Array, Array]]] = {name: [] for name in model.sensors}
    for fold in np.unique(block).tolist():  # of few instants some blocks have none
        tell(f"predicting images that were left out: block {fold + 1} of {folds}")
        part = _refined_from(refined, block != fold)
        for stack in stacks:
            if (seen := block[stack.instant] == fold).any():
                found[stack.sensor].append(_predicted(stack.selected(seen), model.A, part))
    return {
        name: _of_sensor(
            *(np.concatenate(values) for values in zip(*each, strict=True)), camera=refined.intrinsics[name].camera
        )
        for name, each in found.items()
    }


def _refined_from(refined: CornersRefined, kept: np.ndarray) -> CornersRefined:
    """The optimum of the images of some instants (I,) under the noise and the priors of all."""
    model, slots = refined.graph.model, refined.slots
    rest = model.of_instants(kept)
    gone = [("target", name) for name in model.targets if name not in rest.targets]
    gone += [("sensor", name) for name in model.sensors if name not in rest.sensors]
    for what, name in gone:
        raise CountError(f"{what} {name} has all its images in one block; give more folds")
    graph, values, _ = optimum(rest, refined.point)
    point = graph.point(values)
    with told_where_it_fails(rest, point):
        joint, _ = graph.covariance(values, slots)
    check_determined(rest, refined.point, point, joint, slots)
    return replace(
        refined,
        X={name: gtsam.Pose3(T) for name, T in point.X.items()},
        Y={name: gtsam.Pose3(T) for name, T in point.Y.items()},
        intrinsics={
            name: replace(one, camera=one.camera.with_parameters(point.cameras[rest.camera_of[name]]))
            for name, one in refined.intrinsics.items()
        },
        joint=joint,
        graph=graph,
        point=point,
    )


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
    J = np.concatenate(list(model.by_unknown(stack, rows).values()), axis=2)
    index = model.columns(stack, refined.slots)[:, : J.shape[2]]
    squares = ((J @ stack.each(refined.joint[index[:, :, None], index[:, None]])) * J).sum(axis=2)
    if ("p", stack.targets[0]) in refined.slots:  # each corner's own place, which the target's pose goes with
        at, n, by_corners = refined.slots["p", stack.targets[0]], known.shape[1], rows.by_corners
        own = refined.joint[at, at].reshape(n, 3, n, 3)[range(n), :, range(n)]
        mixed = refined.joint[index[0], at].reshape(-1, n, 3)
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
    squares += refined.noise.common_px**2 * (patterns(model, seen, point, OF_AN_IMAGE) ** 2).sum(axis=2)
    expected = 2.0 * refined.noise.corner_px**2 + squares.reshape(*known.shape, 2).sum(axis=2)[known]
    return length, on_target, expected, stack.pixels[known]


def blocks_of(stacks: tuple[Stack, ...], instants: int, folds: int) -> np.ndarray:
    """The block (I,) of each instant: by its place among the images of the pairs that it is in, so that each block has
    a part of every pair."""
    place, count = np.zeros(instants), np.zeros(instants)
    for stack in stacks:
        number, first = np.bincount(stack.target)[stack.target], stack.first[stack.target]
        np.add.at(place, stack.instant, (np.arange(len(number)) - first + 0.5) / number)
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
