"""Cameras as OpenCV has them: pinhole with radial-tangential distortion, or equidistant (fisheye).

Normalised coordinates x = (X / Z, Y / Z) of a point in the camera's optical frame (z forward, x right, y down), pixels
u = f x_distorted + c with pixel centres at whole numbers.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike

from gtsam_rwhec.errors import CameraError
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.vision.distortion import Model, distorted, folding_radius, undistorted

#: The words of ROS, Foxglove, Kalibr and OpenCV for each model.
MODELS: dict[str, Model] = {
    "": "pinhole", "none": "pinhole", "pinhole": "pinhole",
    "plumb_bob": "radtan", "radtan": "radtan", "rational_polynomial": "radtan", "thin_prism": "radtan",
    "equidistant": "equidistant", "equi": "equidistant", "fisheye": "equidistant", "kannala_brandt": "equidistant",
}  # fmt: skip
#: Numbers of distortion coefficients that OpenCV knows for each.
COEFFICIENTS = {"pinhole": (0,), "radtan": (4, 5, 8, 12, 14), "equidistant": (4,)}
#: Focal lengths over the image's larger side beyond which intrinsics are absurd: 0.05 is over 160 degrees for a
#: pinhole, 50 one degree.
FOCAL_RANGE = (0.05, 50.0)
MOST_PIXELS = 1 << 28


@dataclass(frozen=True, eq=False)
class Camera:
    """Intrinsics: image size in pixels, K (3, 3) pixels, D (n,) OpenCV's coefficients in OpenCV's order.

    "radtan": k1, k2, p1, p2[, k3[, k4, k5, k6[, s1, s2, s3, s4]]]; "equidistant": k1, k2, k3, k4 (OpenCV's fisheye).
    """

    width: int
    height: int
    model: Model
    K: Array
    D: Array

    @staticmethod
    def of(width: int, height: int, model: str, K: ArrayLike, D: ArrayLike, where: str) -> Camera:
        """Check and make one.

        Parameters
        ----------
        width, height : int
            Pixels.
        model : str
            A key of `MODELS`.
        K : (3, 3)
        D : (n,)
            Empty for none; further zeros are allowed.
        where : str
            Topic or file, for messages.

        Raises
        ------
        CameraError
            For an unknown model or intrinsics of no camera (zero, not finite, absurd).
        """
        word = model.strip().lower()
        if word not in MODELS:
            raise CameraError(
                f"{where}: distortion model {model!r} is not supported; supported are "
                f"{', '.join(repr(name) for name in MODELS if name)}"
            )
        kind = MODELS[word]
        camera = Camera(int(width), int(height), kind, np.array(K, dtype=float), np.array(D, dtype=float).ravel())
        return camera._checked(where)

    def _checked(self, where: str) -> Camera:
        width, height, K, D = self.width, self.height, self.K, self.D
        if not (width > 0 and height > 0 and width * height <= MOST_PIXELS):
            raise CameraError(
                f"{where}: the image size is {width} x {height} pixels; it must be positive, and at most {MOST_PIXELS} "
                "pixels in all"
            )
        if K.shape != (3, 3) or not np.isfinite(K).all():
            raise CameraError(f"{where}: K is {K.tolist()}; a finite 3 x 3 matrix is needed")
        if not K.any():
            raise CameraError(f"{where}: K is all zeros: the camera was not calibrated (ROS says so in this way)")
        if K[0, 1] != 0.0 or K[1, 0] != 0.0 or K[2].tolist() != [0.0, 0.0, 1.0]:
            raise CameraError(f"{where}: K is {K.tolist()}; it must be [[fx, 0, cx], [0, fy, cy], [0, 0, 1]]")
        largest = max(width, height)
        for name, f in (("fx", K[0, 0]), ("fy", K[1, 1])):
            if not FOCAL_RANGE[0] * largest <= f <= FOCAL_RANGE[1] * largest:
                raise CameraError(
                    f"{where}: {name} = {f:g} pixels for an image of {width} x {height}; is it in another unit, or of "
                    "another resolution?"
                )
        for name, c, size in (("cx", K[0, 2], width), ("cy", K[1, 2], height)):
            if not -size <= c <= 2 * size:
                raise CameraError(f"{where}: {name} = {c:g} is far outside the image of {width} x {height} pixels")
        if not np.isfinite(D).all() or (np.abs(D) > 1e4).any():
            raise CameraError(f"{where}: distortion coefficients {D.tolist()} are those of no lens")
        kind, used = self.model, len(np.trim_zeros(D, "b"))
        if kind == "radtan" and used > 12:
            raise CameraError(
                f"{where}: a tilted sensor (coefficients 13 and 14 are {D[12:].tolist()}) is not supported"
            )
        if kind != "equidistant" and used == 0:
            kind = "pinhole"
        elif kind == "pinhole":
            raise CameraError(
                f"{where}: coefficients {D.tolist()} without a distortion model; say which ('plumb_bob', 'equidistant')"
            )
        fits = [count for count in COEFFICIENTS[kind] if count >= used]
        if not fits:
            raise CameraError(f"{where}: {len(D)} coefficients are too many for the model {self.model}: {D.tolist()}")
        padded = np.zeros(fits[0])
        padded[:used] = D[:used]
        return Camera(width, height, kind, K, padded)

    def project(self, points: Array) -> Array:
        """Pixels (..., 2) of points (..., 3) in the camera's frame, any unit.

        nan behind the camera and beyond `ring`: polynomials bring such points back into the image, lenses do not.
        """
        with np.errstate(divide="ignore", invalid="ignore"):
            x = points[..., :2] / points[..., 2:]
            seen = (points[..., 2:] > 0.0) & (np.linalg.norm(x, axis=-1, keepdims=True) < self.ring)
        return self.pixels(np.where(seen, x, np.nan))

    def pixels(self, x: Array) -> Array:
        """Pixels (..., 2) of normalised coordinates (..., 2)."""
        return distorted(self.model, self.D, x)[0] * self._focal + self._centre

    def pixel_jacobian(self, x: Array) -> tuple[Array, Array]:
        """Pixels (..., 2), and their derivatives (..., 2, 2) by the normalised coordinates (..., 2)."""
        bent, J = distorted(self.model, self.D, x)
        return bent * self._focal + self._centre, self._focal[:, None] * J

    def undistort(self, pixels: Array) -> Array:
        """Normalised coordinates (..., 2) of pixels (..., 2), by Newton; nan where no ray leads there.

        (OpenCV's undistortPoints stops after five rounds of a fixed point, and differs between versions.)
        """
        wanted = (np.asarray(pixels, dtype=float) - self._centre) / self._focal
        return undistorted(self.model, self.D, wanted, self.ring)

    @cached_property
    def ring(self) -> float:
        """Normalised radius at which the radial distortion folds back (or has a pole), infinite where it never does."""
        return folding_radius(self.model, self.D)

    def inside(self, pixels: Array) -> np.ndarray:
        """Which pixels (..., 2) are in the image; (...) booleans."""
        inside = np.asarray((pixels >= -0.5) & (pixels <= np.array([self.width, self.height]) - 0.5))
        return np.asarray(inside.all(axis=-1))

    @property
    def _focal(self) -> Array:
        return np.array([self.K[0, 0], self.K[1, 1]])

    @property
    def _centre(self) -> Array:
        return self.K[:2, 2]
