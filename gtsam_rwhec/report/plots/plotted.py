"""The data of the pictures, beside frames and their covariances: residuals over time, and corners in images."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from gtsam_rwhec.errors import CountError
from gtsam_rwhec.fitting.reprojection_record import Regions
from gtsam_rwhec.geometry.poses import Array


@dataclass(frozen=True, eq=False)
class PlottedMeasurement:
    """All measurements of a pair, with the removed measurements.

    Attributes
    ----------
    stamps_s : (N,) array
        Seconds since a time that all pairs share.
    rotation_deg : (N,) array
        Angle between the measured and the predicted rotation, degrees; nan where the carriers' poses are not known.
    translation_mm : (N,) array
        Distance between the measured and the predicted translation, millimetres; nan as above.
    inlier : (N,) array of bool
        Whether the measurement was used.
    reason : sequence of N str
        Why a measurement was not used. The reasons of used measurements are not read.

    Raises
    ------
    CountError
        The arrays have different lengths.
    """

    stamps_s: Array
    rotation_deg: Array
    translation_mm: Array
    inlier: np.ndarray
    reason: Sequence[str]

    def __post_init__(self) -> None:
        shapes = {name: np.shape(getattr(self, name)) for name in self.__dataclass_fields__}
        if any(shape != (len(self.reason),) for shape in shapes.values()):
            raise CountError(f"give arrays of one length, one entry for each measurement; their shapes are {shapes}")


@dataclass(frozen=True, eq=False)
class PlottedCorners:
    """Targets' corners that a camera saw.

    Attributes
    ----------
    pixels : (N, 2) array
        Where the corners were seen, pixels.
    errors_px : (N, 2) array
        Seen minus predicted, pixels.

    Raises
    ------
    CountError
        An array has another shape.
    """

    pixels: Array
    errors_px: Array

    def __post_init__(self) -> None:
        shapes = np.shape(self.pixels), np.shape(self.errors_px)
        if shapes[0] != shapes[1] or shapes[0][1:] != (2,):
            raise CountError(f"corners and their errors must both be (N, 2); they are {shapes[0]} and {shapes[1]}")


@dataclass(frozen=True, eq=False)
class PlottedIntrinsics:
    """A camera whose intrinsics were estimated from corners.

    Attributes
    ----------
    size : (int, int)
        Width and height of its images, pixels.
    corners : PlottedCorners
        Errors that stay in the refinement, with A of each image as it is there: what the lens model or the board lacks.
    image : (N,) integers
        Which image each corner is from.
    grid : (h, w, 2) array
        Pixels over the image.
    deviations_px : (h, w) array
        Standard deviation of the projection of points at `distance_m` before the camera, of the lens alone; nan where
        it has no ray.
    distance_m : float
    held_out_px : tuple of tuple of float or None
        Error of corners in images that were left out, by region, rows from the top; None where no corner was seen.
        Empty where no images were left out.
    """

    size: tuple[int, int]
    corners: PlottedCorners
    image: np.ndarray
    grid: Array
    deviations_px: Array
    distance_m: float
    held_out_px: Regions = ()
