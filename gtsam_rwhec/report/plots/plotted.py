"""What the pictures are of, beside frames and their covariances: residuals over time, and corners in images."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from gtsam_rwhec.errors import CountError
from gtsam_rwhec.geometry.poses import Array


@dataclass(frozen=True, eq=False)
class PlottedMeasurement:
    """A pair's measurements, those that were removed too.

    Attributes
    ----------
    stamps_s : (N,) array
        Seconds, from any beginning that all pairs share.
    rotation_deg, translation_mm : (N,) arrays
        How far each is from what the answer predicts; nan where it cannot be said (no pose of the carriers).
    inlier : (N,) array of bool
        Whether it was used.
    reason : sequence of N str
        Why it was not; of those that were used, nothing is read.

    Raises
    ------
    CountError
        They are not of one length.
    """

    stamps_s: Array
    rotation_deg: Array
    translation_mm: Array
    inlier: np.ndarray
    reason: Sequence[str]

    def __post_init__(self) -> None:
        shapes = {name: np.shape(getattr(self, name)) for name in self.__dataclass_fields__}
        if any(shape != (len(self.reason),) for shape in shapes.values()):
            raise CountError(f"arrays of one length are needed, one entry a measurement; their shapes are {shapes}")


@dataclass(frozen=True, eq=False)
class PlottedCorners:
    """Targets' corners that a camera saw.

    Attributes
    ----------
    pixels : (N, 2) array
        Where they were seen.
    errors_px : (N, 2) array
        Seen minus predicted, pixels.

    Raises
    ------
    CountError
        They are not of these shapes.
    """

    pixels: Array
    errors_px: Array

    def __post_init__(self) -> None:
        shapes = np.shape(self.pixels), np.shape(self.errors_px)
        if shapes[0] != shapes[1] or shapes[0][1:] != (2,):
            raise CountError(f"corners and their errors must both be (N, 2); they are {shapes[0]} and {shapes[1]}")
