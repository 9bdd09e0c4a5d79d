"""Pictures of flat things through a distorted lens, ray by ray: the geometry is exact.

From each pixel a few rays leave the camera (the lens inverted), meet each thing's plane, and take what is printed
there; the nearest wins. A lamp, a dark disc in front, vignetting, blur and noise come after: they are what detectors
meet, and none of them moves a corner on the average.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from cell_scene.poses import FloatArray

Image = NDArray[np.uint8]

#: Rays of a pixel along each axis: edges are averaged over 9 of them, as a sensor averages over its area.
SAMPLES = 3
#: Rounds of inverting radial and tangential distortion; OpenCV's five leave hundredths of a pixel.
ROUNDS = 25
#: Rays whose pixel comes back this far off (pixels) are where the lens model folds over: nothing is seen there.
FOLDED_PX = 0.05
#: Gray (0 to 1) where no ray meets anything, and of the disc in front.
DARK, DISC = 0.22, 0.12
#: Light that comes from everywhere, and the lamp's from LAMP_M away; ink and paper reflect INK and INK + PAPER of it.
AMBIENT, LAMP, LAMP_M = 0.42, 0.50, 1.6
INK, PAPER = 0.05, 0.93
#: Share of the light that is missing in the image's corners.
VIGNETTE = 0.25


@dataclass(frozen=True, eq=False)
class Lens:
    """A camera as OpenCV has it: "radtan" (k1, k2, p1, p2) or "equidistant" (OpenCV's fisheye: k1 to k4)."""

    width: int
    height: int
    K: FloatArray
    D: FloatArray
    model: Literal["radtan", "equidistant"]

    def coefficients(self) -> FloatArray:
        """D with as many numbers as ROS and Foxglove have for the model: plumb_bob has k3 too."""
        return np.append(self.D, 0.0) if self.model == "radtan" else self.D

    def rays(self, samples: int = SAMPLES) -> FloatArray:
        """Directions (height * samples, width * samples, 3), z = 1, of points spread over each pixel; nan if none."""
        # Pixel centres are at whole numbers.
        u = (np.arange(self.width * samples) + 0.5) / samples - 0.5
        v = (np.arange(self.height * samples) + 0.5) / samples - 0.5
        pixels = np.stack(np.meshgrid(u, v), axis=-1).reshape(-1, 1, 2)
        x = self._undistorted(pixels)
        directions = np.concatenate([x, np.ones((len(x), 1))], axis=1)
        directions[np.abs(self.project(directions) - pixels[:, 0]).max(axis=1) > FOLDED_PX] = np.nan
        return directions.reshape(self.height * samples, self.width * samples, 3)

    def project(self, points: FloatArray) -> FloatArray:
        """Pixels (N, 2) of points (N, 3) in the camera's frame."""
        project = cv2.fisheye.projectPoints if self.model == "equidistant" else cv2.projectPoints
        pixels, _ = project(np.ascontiguousarray(points)[:, None], np.zeros(3), np.zeros(3), self.K, self.D)
        return np.asarray(pixels, dtype=np.float64).reshape(-1, 2)

    def _undistorted(self, pixels: FloatArray) -> FloatArray:
        if self.model == "equidistant":
            return np.asarray(cv2.fisheye.undistortPoints(pixels, self.K, self.D), dtype=np.float64)[:, 0]
        k1, k2, p1, p2 = self.D
        distorted = (pixels[:, 0] - self.K[:2, 2]) / np.diagonal(self.K)[:2]
        x = distorted.copy()
        for _ in range(ROUNDS):
            r2 = (x * x).sum(axis=1)
            xy = x[:, 0] * x[:, 1]
            tangential = np.column_stack(
                [2 * p1 * xy + p2 * (r2 + 2 * x[:, 0] ** 2), p1 * (r2 + 2 * x[:, 1] ** 2) + 2 * p2 * xy]
            )
            x = (distorted - tangential) / (1.0 + k1 * r2 + k2 * r2 * r2)[:, None]
        return x


@dataclass(frozen=True, eq=False)
class Print:
    """A picture on a plane: its middle is the frame's origin, x to the right, y up, z towards who looks at it.

    picture (h, w) in 0 (ink) to 1 (paper), width_m across; bare paper goes on around it for margin_m.
    """

    picture: FloatArray
    width_m: float
    margin_m: float

    def gray(self, x_m: FloatArray, y_m: FloatArray) -> FloatArray:
        """What is printed at points of the plane, interpolated; nan off the paper."""
        h, w = self.picture.shape
        pixel_m = self.width_m / w
        height_m = h * pixel_m
        value = cv2.remap(
            self.picture.astype(np.float32),
            ((x_m + 0.5 * self.width_m) / pixel_m - 0.5).astype(np.float32),
            ((0.5 * height_m - y_m) / pixel_m - 0.5).astype(np.float32),
            cv2.INTER_LINEAR,
            borderMode=cv2.BORDER_CONSTANT,
            borderValue=1.0,
        ).astype(np.float64)
        off = (np.abs(x_m) > 0.5 * self.width_m + self.margin_m) | (np.abs(y_m) > 0.5 * height_m + self.margin_m)
        value[off] = np.nan
        return value


@dataclass(frozen=True)
class Disc:
    """Something dark right before the camera; shares of the image's width."""

    u: float
    v: float
    radius: float


def render(
    rays: FloatArray,
    things: list[tuple[Print, FloatArray]],
    *,
    lamp: FloatArray,
    blur_px: float,
    noise: float,
    disc: Disc | None,
    generator: np.random.Generator,
    samples: int = SAMPLES,
) -> Image:
    """One picture, (height, width) gray.

    Parameters
    ----------
    rays : (height * samples, width * samples, 3) array
        Of ``Lens.rays``.
    things : list of (Print, T_camera_print (4, 4))
    lamp : (3,) array
        Where it hangs, metres, camera axes.
    blur_px, noise : float
        Standard deviations: of the blur, and of the gray values (of 255).
    disc : Disc or None
        Hides what is behind it.
    generator : numpy.random.Generator
        Of the noise.
    samples : int
        Those of the rays.
    """
    light = np.full(rays.shape[:2], DARK)
    nearest = np.full(rays.shape[:2], np.inf)
    for thing, T in things:
        normal = T[:3, 2]
        along = rays @ normal
        with np.errstate(divide="ignore", invalid="ignore"):
            depth = (normal @ T[:3, 3]) / along  # z of the point where a ray meets the plane: rays have z = 1
        hit = np.isfinite(depth) & (depth > 0.05) & (along < 0.0) & (depth < nearest)
        rows, columns = np.flatnonzero(hit.any(axis=1)), np.flatnonzero(hit.any(axis=0))
        if not len(rows):
            continue
        part = np.s_[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]
        points = np.nan_to_num(rays[part] * depth[part][..., None], nan=1e6, posinf=1e6, neginf=-1e6)
        gray = thing.gray((points - T[:3, 3]) @ T[:3, 0], (points - T[:3, 3]) @ T[:3, 1])
        seen = hit[part] & np.isfinite(gray)
        light[part][seen] = (INK + PAPER * gray[seen]) * _brightness(points[seen], normal, lamp)
        nearest[part][seen] = depth[part][seen]
    height, width = (size // samples for size in light.shape)
    picture = light.reshape(height, samples, width, samples).mean(axis=(1, 3))
    u, v = np.meshgrid(np.arange(width) / width, np.arange(height) / width)
    if disc is not None:
        picture[np.hypot(u - disc.u, v - disc.v) < disc.radius] = DISC
    from_middle = ((u - 0.5) ** 2 + (v - 0.5 * height / width) ** 2) / (0.25 + 0.25 * (height / width) ** 2)
    picture *= 1.0 - VIGNETTE * from_middle
    blurred = cv2.GaussianBlur(picture, (0, 0), blur_px)
    noisy = 255.0 * blurred + generator.normal(0.0, noise, picture.shape)
    return np.asarray(np.clip(np.rint(noisy), 0, 255), dtype=np.uint8)


def _brightness(points: FloatArray, normal: FloatArray, lamp: FloatArray) -> FloatArray:
    """Of a plane at points (N, 3): less where the lamp is far or shines along it."""
    to_lamp = lamp - points
    distance = np.linalg.norm(to_lamp, axis=1)
    facing = np.clip(to_lamp @ normal / distance, 0.0, None)
    return np.asarray(np.clip(AMBIENT + LAMP * facing * (LAMP_M / distance) ** 2, 0.0, 1.0))


def tag(number: int, size_m: float, margin_m: float) -> Print:
    """A tag of 36h11, size_m along its black square."""
    family = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)
    modules = cv2.aruco.generateImageMarker(family, number, 8, borderBits=1)
    # Many pixels a module, so that interpolation does not soften its edges.
    return Print(np.kron(modules / 255.0, np.ones((24, 24))), size_m, margin_m)


def mottled(width_m: float, height_m: float, *, low: float, high: float, seed: int) -> Print:
    """A surface with soft spots some 10 cm wide, so that no threshold has it easy."""
    spots = np.random.default_rng(seed).uniform(low, high, (round(height_m / 0.1), round(width_m / 0.1)))
    return Print(cv2.resize(spots, None, fx=16, fy=16, interpolation=cv2.INTER_LINEAR), width_m, 0.0)
