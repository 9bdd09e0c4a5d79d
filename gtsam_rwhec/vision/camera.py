"""Cameras as OpenCV has them: pinhole with radial-tangential distortion, or equidistant (fisheye).

Normalised coordinates x = (X / Z, Y / Z) of a point in the camera's optical frame (z forward, x right, y down), pixels
u = f x_distorted + c with pixel centres at whole numbers.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import numpy as np
from numpy.polynomial import Polynomial
from numpy.typing import ArrayLike

from gtsam_rwhec.errors import CameraError
from gtsam_rwhec.geometry.poses import Array

Model = Literal["pinhole", "radtan", "equidistant"]

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
#: Newton's steps of undistorting, and how near (normalised) they must come.
STEPS, NEAR = 30, 1e-10


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
        return self._distorted(x)[0] * self._focal + self._centre

    def pixel_jacobian(self, x: Array) -> tuple[Array, Array]:
        """Pixels (..., 2), and their derivatives (..., 2, 2) by the normalised coordinates (..., 2)."""
        distorted, J = self._distorted(x)
        return distorted * self._focal + self._centre, self._focal[:, None] * J

    def undistort(self, pixels: Array) -> Array:
        """Normalised coordinates (..., 2) of pixels (..., 2), by Newton; nan where no ray leads there.

        (OpenCV's undistortPoints stops after five rounds of a fixed point, and differs between versions.)
        """
        wanted = (np.asarray(pixels, dtype=float) - self._centre) / self._focal
        if self.model == "pinhole":
            return wanted
        if self.model == "equidistant":
            return self._undistorted_fisheye(wanted)
        x = wanted.copy()
        with np.errstate(all="ignore"):
            for _ in range(STEPS):
                distorted, J = self._distorted(x)
                det = J[..., 0, 0] * J[..., 1, 1] - J[..., 0, 1] * J[..., 1, 0]
                off = wanted - distorted
                step = np.stack(
                    [
                        J[..., 1, 1] * off[..., 0] - J[..., 0, 1] * off[..., 1],
                        J[..., 0, 0] * off[..., 1] - J[..., 1, 0] * off[..., 0],
                    ],
                    axis=-1,
                )
                step /= det[..., None]
                # Beyond the ring where distortion folds back (det <= 0) nothing is seen.
                x = np.where(det[..., None] > 0.0, x + step, np.nan)
                if not np.nanmax(np.abs(step), initial=0.0) > NEAR:
                    break
            reached = (np.abs(self._distorted(x)[0] - wanted) < 1e-8).all(axis=-1, keepdims=True)
            within = np.linalg.norm(x, axis=-1, keepdims=True) < self.ring
        return np.where(reached & within, x, np.nan)

    def _undistorted_fisheye(self, wanted: Array) -> Array:
        """As `undistort`, of distorted normalised coordinates: Newton on the angle, at which tan does not run away."""
        k1, k2, k3, k4 = self.D
        curve = Polynomial([0.0, 1.0, 0.0, k1, 0.0, k2, 0.0, k3, 0.0, k4])
        slope = curve.deriv()
        furthest = float(np.arctan(self.ring))
        theta_d = np.linalg.norm(wanted, axis=-1, keepdims=True)
        theta = np.minimum(theta_d, furthest)
        with np.errstate(all="ignore"):
            for _ in range(STEPS):
                before = theta
                theta = np.clip(theta + (theta_d - curve(theta)) / slope(theta), 0.0, furthest)
                if not np.nanmax(np.abs(theta - before), initial=0.0) > NEAR:
                    break
            seen = (np.abs(curve(theta) - theta_d) < 1e-9) & (theta < furthest)
            return np.where(seen, wanted * np.where(theta_d > 0.0, np.tan(theta) / theta_d, 1.0), np.nan)

    @cached_property
    def ring(self) -> float:
        """Normalised radius at which the radial distortion folds back (or has a pole), infinite where it never does."""
        if self.model == "pinhole":
            return float("inf")
        if self.model == "equidistant":
            # d theta_d / d theta, in theta^2
            squared = _first_root(Polynomial([1.0, *(self.D * [3.0, 5.0, 7.0, 9.0])]))
            return float(np.tan(np.sqrt(squared))) if squared < (0.5 * np.pi) ** 2 else float("inf")
        k1, k2, _, _, k3, k4, k5, k6 = np.pad(self.D, (0, 8))[:8]
        above, below = Polynomial([1.0, k1, k2, k3]), Polynomial([1.0, k4, k5, k6])
        # d(r above / below) / dr, times below^2, in r^2
        slope = above * below + Polynomial([0.0, 2.0]) * (above.deriv() * below - above * below.deriv())
        return float(np.sqrt(min(_first_root(slope), _first_root(below))))

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

    def _distorted(self, x: Array) -> tuple[Array, Array]:
        """Distorted normalised coordinates (..., 2) and their derivatives (..., 2, 2)."""
        if self.model == "equidistant":
            return _equidistant(x, self.D)
        if self.model == "radtan":
            return _radtan(x, self.D)
        return x, np.broadcast_to(np.eye(2), (*x.shape[:-1], 2, 2))


def _first_root(polynomial: Polynomial) -> float:
    """Smallest real root above 0 of a polynomial that is 1 at 0; infinite if it has none."""
    # Of its reciprocals: the last coefficients may be next to nothing, the first is not.
    roots = np.roots(polynomial.coef)
    inverse = float(roots[(np.abs(roots.imag) < 1e-9 * np.abs(roots)) & (roots.real > 0.0)].real.max(initial=0.0))
    return 1.0 / inverse if inverse > 1e-12 else float("inf")


def _radtan(x: Array, D: Array) -> tuple[Array, Array]:
    """OpenCV's calib3d, "Detailed Description": x g(r^2) + tangential + thin prism, g rational."""
    k1, k2, p1, p2, k3, k4, k5, k6, s1, s2, s3, s4 = np.pad(D, (0, 14))[:12]
    a, b = x[..., 0], x[..., 1]
    r2 = a * a + b * b
    above, below = 1 + r2 * (k1 + r2 * (k2 + r2 * k3)), 1 + r2 * (k4 + r2 * (k5 + r2 * k6))
    g = above / below
    # dg / d(r^2)
    dg = (k1 + r2 * (2 * k2 + 3 * k3 * r2) - g * (k4 + r2 * (2 * k5 + 3 * k6 * r2))) / below
    ab = a * b
    distorted = np.stack(
        [
            a * g + 2 * p1 * ab + p2 * (r2 + 2 * a * a) + r2 * (s1 + s2 * r2),
            b * g + p1 * (r2 + 2 * b * b) + 2 * p2 * ab + r2 * (s3 + s4 * r2),
        ],
        axis=-1,
    )
    J = np.empty((*x.shape, 2))
    mixed = 2 * ab * dg + 2 * p1 * a + 2 * p2 * b
    prism_a, prism_b = s1 + 2 * s2 * r2, s3 + 2 * s4 * r2
    J[..., 0, 0] = g + 2 * a * a * dg + 2 * p1 * b + 6 * p2 * a + 2 * a * prism_a
    J[..., 0, 1] = mixed + 2 * b * prism_a
    J[..., 1, 0] = mixed + 2 * a * prism_b
    J[..., 1, 1] = g + 2 * b * b * dg + 6 * p1 * b + 2 * p2 * a + 2 * b * prism_b
    return distorted, J


def _equidistant(x: Array, D: Array) -> tuple[Array, Array]:
    """OpenCV's fisheye: theta_d = theta (1 + k1 theta^2 + ... + k4 theta^8), x theta_d / r, r = tan theta."""
    r2 = np.einsum("...i,...i->...", x, x)
    r = np.sqrt(r2)
    theta = np.arctan(r)
    t2 = theta * theta
    k1, k2, k3, k4 = D
    theta_d = theta * (1 + t2 * (k1 + t2 * (k2 + t2 * (k3 + t2 * k4))))
    slope = 1 + t2 * (3 * k1 + t2 * (5 * k2 + t2 * (7 * k3 + t2 * 9 * k4)))
    small = r < 1e-6
    safe = np.where(small, 1.0, r)
    g = np.where(small, 1.0 + (k1 - 1.0 / 3.0) * r2, theta_d / safe)
    # (1/r) dg/dr, with dtheta/dr = 1 / (1 + r^2)
    dg = np.where(small, 2.0 * (k1 - 1.0 / 3.0), (slope / (1.0 + r2) - g) / (safe * safe))
    J = g[..., None, None] * np.eye(2) + dg[..., None, None] * x[..., :, None] * x[..., None, :]
    return x * g[..., None], J
