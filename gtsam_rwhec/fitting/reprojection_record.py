"""What a refinement from corners found besides poses: intrinsics, boards, and errors in pixels; as files keep it."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np

from gtsam_rwhec.cameras.camera import Camera
from gtsam_rwhec.errors import CameraError
from gtsam_rwhec.files.terminal_text import rounded

#: The name of a board's size among its numbers: its covariance is that of the target's scale.
SIZE = "size"
#: The names of a board's warp, by its axis.
WARPS = {"x": "warp_x", "y": "warp_y", "xy": "warp_xy"}
#: By region of the image, rows from the top, columns from the left; None where no corner was seen.
Regions = tuple[tuple[float | None, ...], ...]


#: Degrees and millimetres of noise below this are none, for who reads them.
LEAST = 0.001


@dataclass(frozen=True)
class SensorReprojection:
    """Errors of a sensor's corners."""

    #: Numbers of images and corners used, and of corners that disagree with all others.
    images: int
    corners: int
    left_out: int
    #: Root mean square of the corners that count, along each axis, pixels.
    rms_px: float
    #: Root mean square length of the error in images that were left out; in pixels, and on the target. None where
    #: images are too few to leave some out.
    held_out_px: float | None = None
    held_out_mm: float | None = None
    #: `held_out_px` by region of the image, rows from the top; None where no corner was seen.
    regions_px: Regions = ()
    #: What the covariances say of `held_out_px`: errors that are larger by far show what the model lacks.
    expected_px: float | None = None


@dataclass(frozen=True)
class TriedModel:
    """A model that was tried."""

    #: What it takes as known.
    words: str
    #: How well it predicts images that were left out: in pixels, and on the target.
    held_out_px: float
    held_out_mm: float
    is_chosen: bool

    def __str__(self) -> str:
        """One line: the error, then the model."""
        chosen = " (chosen)" if self.is_chosen else ""
        return f"{self.held_out_mm:.3f} mm, {self.held_out_px:.3f} px: {self.words}{chosen}"


@dataclass(frozen=True)
class Consequence:
    """How far a frame would be off."""

    frame: str
    #: In words, with its size.
    cause: str
    #: Of A's noise: one standard deviation, along the worst axis.
    rotation_deg: float
    translation_mm: float

    def __str__(self) -> str:
        """One sentence, without its full stop."""
        return (
            f"{self.cause} would move {self.frame} by {rounded(self.translation_mm)} mm and "
            f"{rounded(self.rotation_deg)} degrees"
        )


@dataclass(frozen=True)
class BoardShape:
    """What was estimated of a board."""

    #: "size" (its size less the stated one, a share of 1), "warp_x" and "warp_y" (heights of its edge over its middle
    #: along x and y, metres) and "warp_xy" (how much farther up it is along one diagonal than along the other).
    names: tuple[str, ...]
    #: In that order.
    values: tuple[float, ...]
    standard_deviations: tuple[float, ...]
    #: How far each corner is from its place on the board of that size and bend, in the target's axes, and its
    #: deviations, metres; empty where corners were not free.
    corners_off_m: tuple[tuple[float, ...], ...] = ()
    corners_deviations_m: tuple[tuple[float, ...], ...] = ()

    def __str__(self) -> str:
        """What was found, in percent and millimetres."""
        found = {name: at for at, name in enumerate(self.names)}
        said = []
        if SIZE in found:
            true, deviation = 1.0 + self.values[found[SIZE]], self.standard_deviations[found[SIZE]]
            off = 100.0 * (1.0 / true - 1.0)  # of the stated size over the true one, as scales are, and the verdict
            which = "large" if off > 0.0 else "small"
            said.append(f"its stated size is {abs(off):.3f} ± {rounded(100.0 * deviation / true**2)} % too {which}")
        for axis, name in WARPS.items():
            if name in found:
                height, deviation = (1e3 * each[found[name]] for each in (self.values, self.standard_deviations))
                where = "along x = y less that along x = -y" if axis == "xy" else f"along {axis}"
                said.append(f"its edge {where} is {height:+.3f} ± {rounded(deviation)} mm above its middle")
        if self.corners_off_m:
            off, deviation = (
                1e3 * float(np.sqrt((np.array(each) ** 2).sum(axis=1).mean()))
                for each in (self.corners_off_m, self.corners_deviations_m)
            )
            said.append(f"its corners are {off:.3f} mm rms from their places, each known to {rounded(deviation)} mm")
        return "; ".join(said)


@dataclass(frozen=True)
class Reprojection:
    """A refinement from corners in numbers."""

    #: Root mean square of all corners that count, along each axis, pixels.
    rms_px: float
    #: Standard deviation of a corner along each axis, as estimated.
    corner_px: float
    #: Whether the carriers' poses A count as exact, or their noise was estimated or given.
    carrier_poses: Literal["exact", "estimated", "given"]
    #: A's noise about and along each axis; 0 where A is exact.
    carrier_rotation_rad: float
    carrier_translation_m: float
    sensors: dict[str, SensorReprojection]
    #: By target, where something of it is free.
    boards: dict[str, BoardShape]
    #: The models that were compared, the best first.
    tried: tuple[TriedModel, ...]
    #: What errors of kept intrinsics, and of A, would do to each frame.
    consequences: tuple[Consequence, ...]
    #: Standard deviation of what the corners of an image share (`corner_patterns`), as estimated.
    common_px: float = 0.0

    def __str__(self) -> str:
        """What was refined, and how well it fits, in two sentences."""
        corners = sum(of.corners for of in self.sensors.values())
        images = sum(of.images for of in self.sensors.values())
        rotation, translation = math.degrees(self.carrier_rotation_rad), 1e3 * self.carrier_translation_m
        noise = f"{_size(rotation)}° and {_size(translation)} mm for each axis"
        of_A = {
            "exact": "The carriers' poses A count as exact.",
            "estimated": f"The carriers' poses A were refined too; their noise, as the corners show it: {noise}.",
            "given": f"The carriers' poses A were refined too, within the noise that was given: {noise}.",
        }[self.carrier_poses]
        shared = f", and all corners of an image are off together by {self.common_px:.2g} px" if self.common_px else ""
        return (
            f"The poses are refined from {corners} corners in {images} images: rms {self.rms_px:.3f} px along each "
            f"axis, where the noise of a corner is {self.corner_px:.3f} px{shared}. {of_A}"
        )


@dataclass(frozen=True)
class Intrinsics:
    """A sensor's intrinsics as they were estimated; its parameters are `Camera.parameters`."""

    #: As `Camera.model`.
    model: str
    #: Pixels.
    width: int
    height: int
    #: Other sensors with the same camera.
    shared_with: tuple[str, ...]
    #: Of the parameters.
    names: tuple[str, ...]
    values: tuple[float, ...]
    standard_deviations: tuple[float, ...]
    #: What was stated: the prior's mean.
    stated: tuple[float, ...]
    #: The prior's, as widened; infinite: no prior.
    stated_deviations: tuple[float, ...]
    stated_as: Literal["exact", "calibration", "nominal", "unknown"]
    #: By how much the prior was widened: 1 where the images do not contradict what was stated.
    widened: float
    #: How far what was stated is from what the images say, in standard deviations.
    innovation_deviations: float
    #: Parameters that the images do not determine.
    held_by_prior: tuple[str, ...]
    #: Root mean square error, along each axis, of the corners that count.
    rms_px: float
    #: Parameters that were held as stated: images that were left out are predicted as well without them.
    not_free: tuple[str, ...] = ()
    #: Standard deviation of the projection of points at `projection_m` before the camera, pixels, by region of the
    #: image: from the lens alone, with the pose refitted to the corners for each error of the lens.
    projection_px: Regions = ()
    projection_m: float = 0.0

    def __str__(self) -> str:
        """How they were stated, whether the images agree, and what the images do not determine."""
        if self.stated_as == "exact":
            return "they count as exact, as was said: their errors are not in the standard deviations"
        if self.stated_as == "unknown":
            said = ["no stated ones count, so the images alone tell them"]
        else:
            origin = "a calibration's" if self.stated_as == "calibration" else "nominal ones"
            said = [f"estimated, with a prior from what was stated ({origin})"]
            off = f"{self.innovation_deviations:.1f} deviations off"
            if self.widened > 1.0:
                said.append(f"the images are {off}, so the prior was widened {rounded(self.widened)} times")
            else:
                said.append(f"the images agree with it ({off})")
        if self.held_by_prior:
            held = ", ".join(self.held_by_prior)
            by = "nothing else tells them" if self.stated_as == "unknown" else "only the prior holds them"
            said.append(f"the images do not determine {held}: {by}")
        return "; ".join(said)

    @property
    def camera(self) -> Camera:
        """The camera with these intrinsics."""
        return camera_of(self, self.values)

    @property
    def fault(self) -> str:
        """Why no camera has these intrinsics, in words; empty where one has."""
        try:
            camera_of(self, self.values)
        except CameraError as error:
            return str(error)
        return ""

    @property
    def stated_camera(self) -> Camera:
        """The camera as it was stated."""
        return camera_of(self, self.stated)


def lens_of(intrinsics: Intrinsics) -> Camera:
    """A camera of the same model and size, without numbers."""
    return Camera(intrinsics.width, intrinsics.height, intrinsics.model, np.eye(3), np.zeros(0))  # type: ignore[arg-type]


def camera_of(intrinsics: Intrinsics, values: tuple[float, ...]) -> Camera:
    """The camera with some values of an intrinsics' parameters; CameraError where they are none."""
    camera = lens_of(intrinsics).with_parameters(np.array(values))
    return Camera.of(camera.width, camera.height, camera.model, camera.K, camera.D, "intrinsics of the result")


def _size(value: float) -> str:
    return rounded(value) if value >= LEAST else f"under {LEAST:g}"
