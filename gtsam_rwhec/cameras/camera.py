"""Cameras with OpenCV's models: pinhole with radial-tangential distortion, equidistant (fisheye), or unified (omnidir).

A point in the camera's optical frame (z forward, x right, y down) has normalised coordinates x = (X / Z, Y / Z) and
pixels u = f x_distorted + c. Pixel centres are at whole numbers.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from gtsam_rwhec.cameras.distortion import Model, distorted, folding_radius, undistorted
from gtsam_rwhec.errors import CameraError
from gtsam_rwhec.geometry.poses import Array

#: COLMAP has the middle of the upper left pixel at (0.5, 0.5), `Camera` at (0, 0).
PIXEL_CENTRE = 0.5
#: ROS, Foxglove, Kalibr and OpenCV name the models by these words.
MODELS: dict[str, Model] = {
    "": "pinhole", "none": "pinhole", "pinhole": "pinhole",
    "plumb_bob": "radtan", "radtan": "radtan", "rational_polynomial": "radtan", "thin_prism": "radtan",
    "equidistant": "equidistant", "equi": "equidistant", "fisheye": "equidistant", "kannala_brandt": "equidistant",
    "unified": "unified",
}  # fmt: skip
#: OpenCV takes these numbers of distortion coefficients for each model.
COEFFICIENTS = {"pinhole": (0,), "radtan": (4, 5, 8, 12, 14), "equidistant": (4,), "unified": (5,)}
#: Names of the coefficients.
NAMES = {"radtan": "k1 k2 p1 p2 k3 k4 k5 k6 s1 s2 s3 s4", "equidistant": "k1 k2 k3 k4", "unified": "xi k1 k2 p1 p2"}
#: The unified model of a pinhole has xi = 0, of a parabolic mirror 1, of fisheye lenses up to about 3.
XI_RANGE = (-0.9, 20.0)
#: The focal length over the image's larger side must be within this range. For a pinhole, 0.05 is a field of view of
#: over 160 degrees, and 50 is one of one degree.
FOCAL_RANGE = (0.05, 50.0)
#: An image has at most this many pixels, which are 2^28 bytes in gray.
MOST_PIXELS = 1 << 28


@dataclass(frozen=True, eq=False)
class Camera:
    """Intrinsics of a camera."""

    #: Size of the images, pixels
    width: int
    height: int
    #: "pinhole", "radtan", "equidistant" (OpenCV's fisheye) or "unified" (OpenCV's omnidir, Kalibr's omni-radtan)
    model: Model
    K: Array  #: (3, 3): camera matrix, pixels
    #: (n,): openCV's distortion coefficients. "radtan": k1, k2, p1, p2[, k3[, k4, k5, k6[, s1, s2, s3, s4]]];
    #: "equidistant": k1, k2, k3, k4; "unified": xi, k1, k2, p1, p2.
    D: Array

    @staticmethod
    def of(width: int, height: int, model: str, K: ArrayLike, D: ArrayLike, where: str) -> Camera:
        """Return a camera with checked intrinsics.

        Parameters
        ----------
        width, height : int
            Pixels.
        model : str
            A key of `MODELS`.
        K : (3, 3)
        D : (n,)
            Empty without distortion. Zeros may follow the coefficients.
        where : str
            Topic or file, for messages.

        Raises
        ------
        CameraError
            The model is unknown, or no camera has these intrinsics (zero, not finite, absurd).
        """
        word = model.strip().lower()
        if word not in MODELS:
            raise CameraError(
                f"{where}: distortion model {model!r} is not supported; supported are "
                f"{', '.join(repr(name) for name in MODELS if name)}"
            )
        if MODELS[word] == "unified" and not np.size(D):
            raise CameraError(f"{where}: a unified camera needs xi, the first of D: [xi, k1, k2, p1, p2]")
        matrix, coefficients = np.array(K, dtype=float), np.trim_zeros(np.array(D, dtype=float).ravel(), "b")
        camera = Camera(int(width), int(height), MODELS[word], matrix, coefficients)
        fault = camera._fault()
        if fault:
            raise CameraError(f"{where}: {fault}")
        kind = camera.model if camera.model == "equidistant" or len(coefficients) else "pinhole"
        count = next(count for count in COEFFICIENTS[kind] if count >= len(coefficients))
        return replace(camera, model=kind, D=np.pad(coefficients, (0, count - len(coefficients))))

    @property
    def numbers(self) -> dict[str, Any]:
        """Its size, model, K and D, as files have them and `of` takes them."""
        named = {"width": self.width, "height": self.height, "model": self.model}
        return {**named, "K": self.K.tolist(), "D": self.D.tolist()}

    def _fault(self) -> str:
        """Why no supported camera has these intrinsics, with D without trailing zeros; empty if a camera can."""
        width, height, K, D = self.width, self.height, self.K, self.D
        if not (width > 0 and height > 0 and width * height <= MOST_PIXELS):
            limits = f"both must be positive, and the product at most {MOST_PIXELS}"
            return f"the image size is {width} x {height} pixels; {limits}"
        if K.shape != (3, 3) or not np.isfinite(K).all():
            return f"K is {K.tolist()}; give a finite 3 x 3 matrix"
        if not K.any():
            return "K is all zeros: the camera was not calibrated (this is how ROS says it). Calibrate it"
        if K[0, 1] != 0.0 or K[1, 0] != 0.0 or K[2].tolist() != [0.0, 0.0, 1.0]:
            return f"K is {K.tolist()}; it must be [[fx, 0, cx], [0, fy, cy], [0, 0, 1]], without skew"
        image = f"image of {width} x {height} pixels"
        for name, f in (("fx", K[0, 0]), ("fy", K[1, 1])):
            if not FOCAL_RANGE[0] <= f / max(width, height) <= FOCAL_RANGE[1]:
                return f"{name} = {f:g} pixels for an {image}; is the unit pixels, and the resolution right?"
        for name, c, size in (("cx", K[0, 2], width), ("cy", K[1, 2], height)):
            if not -size <= c <= 2 * size:
                return f"{name} = {c:g} is far outside the {image}"
        if not np.isfinite(D).all() or (np.abs(D) > 1e4).any():
            return f"distortion coefficients {D.tolist()}; no lens has them"
        if self.model == "radtan" and len(D) > 12:
            return f"a tilted sensor (coefficients 13 and 14 are {D[12:].tolist()}) is not supported"
        if self.model == "pinhole" and len(D):
            return f"coefficients {D.tolist()} without a distortion model; give 'plumb_bob' or 'equidistant'"
        if self.model == "unified" and not XI_RANGE[0] <= np.append(D, 0.0)[0] <= XI_RANGE[1]:
            return f"xi = {D[0]:g}, the first of D, must be between {XI_RANGE[0]:g} and {XI_RANGE[1]:g}"
        if len(D) > COEFFICIENTS[self.model][-1]:
            return f"{len(D)} coefficients are too many for the model {self.model}: {D.tolist()}"
        return ""

    def project(self, points: Array) -> Array:
        """Pixels (..., 2) of points (..., 3) in the camera's frame, any unit.

        They are nan behind the camera and beyond `ring`, where the polynomials fold back into the image, as no lens
        does.
        """
        with np.errstate(divide="ignore", invalid="ignore"):
            x = points[..., :2] / points[..., 2:]
            seen = (points[..., 2:] > 0.0) & (np.linalg.norm(x, axis=-1, keepdims=True) < self.ring)
        return self.pixels(np.where(seen, x, np.nan))

    def pixels(self, x: Array) -> Array:
        """Pixels (..., 2) of normalised coordinates (..., 2)."""
        return distorted(self.model, self.D, x)[0] * self._focal + self._centre

    def pixel_jacobian(self, x: Array) -> tuple[Array, Array]:
        """Pixels (..., 2) of normalised coordinates (..., 2), and their derivatives (..., 2, 2)."""
        bent, J = distorted(self.model, self.D, x)
        return bent * self._focal + self._centre, self._focal[:, None] * J

    def undistort(self, pixels: Array) -> Array:
        """Normalised coordinates (..., 2) of pixels (..., 2), by Newton; nan where no ray leads to a pixel.

        OpenCV's undistortPoints stops after five rounds of a fixed point, and differs between versions.
        """
        wanted = (np.asarray(pixels, dtype=float) - self._centre) / self._focal
        return undistorted(self.model, self.D, wanted, self.ring)

    def has_ray(self, pixels: Array) -> np.ndarray:
        """Whether a ray leads to pixels (..., 2); booleans (...), true where a pixel is nan."""
        found = np.isfinite(self.undistort(pixels)) | np.isnan(pixels)
        return np.asarray(found.all(axis=-1))

    @property
    def reach_px(self) -> float:
        """The largest distance from the principal point, along x, of a pixel that has a ray."""
        with np.errstate(over="ignore"):
            furthest = self.pixels(np.array([min((1.0 - 1e-9) * self.ring, 1e9), 0.0]))
        return float(np.linalg.norm(furthest - self._centre))

    @property
    def share_beyond_fold(self) -> float:
        """The share of the image's pixels without a ray because the distortion folds back; 0 if it does not."""
        if not np.isfinite(self.ring):
            return 0.0
        u, v = ((np.arange(40.0) + 0.5) * size / 40.0 - 0.5 for size in (self.width, self.height))
        return 1.0 - float(self.has_ray(np.stack(np.meshgrid(u, v), axis=-1)).mean())

    @cached_property
    def ring(self) -> float:
        """Normalised radius at which the radial distortion folds back or has a pole; infinite if it does neither."""
        return folding_radius(self.model, self.D)

    @property
    def parameters(self) -> Array:
        """Parameters (4 + n,): fx, fy, cx, cy and D; for a unified camera fx / (1 + xi), fy / (1 + xi), cx, cy and D.

        fx / (1 + xi) is the number of pixels per rad at the optical axis, which images determine; f and xi are
        correlated.
        """
        K = self.K
        return np.concatenate([self._focal / self._zoom, [K[0, 2], K[1, 2]], self.D])

    @property
    def parameter_names(self) -> tuple[str, ...]:
        """The names of `parameters`."""
        of_f = ("fx/(1+xi)", "fy/(1+xi)") if self.model == "unified" else ("fx", "fy")
        return (*of_f, "cx", "cy", *NAMES.get(self.model, "").split()[: len(self.D)])

    def with_parameters(self, parameters: Array) -> Camera:
        """The camera with other numbers, unchecked."""
        fx, fy, cx, cy, *D = parameters.tolist()
        changed = replace(self, K=np.eye(3), D=np.array(D))
        zoom = changed._zoom
        return replace(changed, K=np.array([[zoom * fx, 0.0, cx], [0.0, zoom * fy, cy], [0.0, 0.0, 1.0]]))

    @property
    def focal_px(self) -> float:
        """Pixels per rad at the optical axis, the mean of both directions."""
        return float(self._focal.mean()) / self._zoom

    @property
    def _zoom(self) -> float:
        return 1.0 + float(self.D[0]) if self.model == "unified" else 1.0

    def inside(self, pixels: Array) -> np.ndarray:
        """Whether pixels (..., 2) are in the image; booleans (...)."""
        inside = np.asarray((pixels >= -0.5) & (pixels <= np.array([self.width, self.height]) - 0.5))
        return np.asarray(inside.all(axis=-1))

    @property
    def _focal(self) -> Array:
        return np.array([self.K[0, 0], self.K[1, 1]])

    @property
    def _centre(self) -> Array:
        return self.K[:2, 2]
