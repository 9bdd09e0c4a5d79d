"""What is known of a camera before the images are looked at: its stated parameters, and how far they may be off.

Intrinsics are stated by a calibration, or they are nominal: from a data sheet, a simulator, another camera of the same
kind. A calibration without a covariance is taken to be right to 0.3 % of the focal length and 3 pixels of the centre;
nominal intrinsics to 3 %, and to 30 pixels or 2 % of the image's width, whichever is more. Coefficients of the
lens model move the image's corner by a calibration's 3 pixels, or by a nominal 5 % of the focal length. Unknown ones
are right to the focal length itself and half the width: the images must say them. Exact ones are held: their
deviations are so small that no number of corners tells anything of them.
"""

from __future__ import annotations

from typing import Literal

import numpy as np

from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.reprojection.lens import PINHOLE, parameters_of, pixels_and_derivatives
from gtsam_rwhec.vision.camera import Camera

Stated = Literal["exact", "calibration", "nominal", "unknown"]

#: Deviation of the focal length (a share), of the centre (pixels), and of the coefficients (pixels at the corner of
#: the image, or a share of the focal length).
FOCAL = {"exact": 1e-8, "calibration": 0.003, "nominal": 0.03, "unknown": 1.0}
CENTRE_PX = {"exact": 1e-5, "calibration": 3.0, "nominal": 30.0, "unknown": 30.0}
CENTRE_OF_WIDTH = {"exact": 0.0, "calibration": 0.0, "nominal": 0.02, "unknown": 0.5}
LENS_PX = {"exact": 1e-5, "calibration": 3.0}
LENS_OF_FOCAL = {"nominal": 0.05, "unknown": 0.5}
#: xi of a nominal unified camera is right to this share of 1 + xi. It bends the image as k1 does, but along a curve:
#: where xi is as free as the other coefficients, their linear deviations hold the truth in 78 to 88 % of simulations.
XI_OF_NOMINAL = 0.05


def free_model(camera: Camera, stated: Stated) -> Camera:
    """The camera with the lens model that is estimated: a pinhole may have distortion that nobody stated."""
    if camera.model == "pinhole" and stated != "exact":
        return Camera(camera.width, camera.height, "radtan", camera.K, np.zeros(4))
    return camera


def prior_of(camera: Camera, stated: Stated) -> tuple[Array, Array]:
    """Mean (m,) and standard deviation (m,) of a camera's parameters."""
    mean = parameters_of(camera)
    f, c = mean[:2], max(CENTRE_PX[stated], CENTRE_OF_WIDTH[stated] * camera.width)
    lens_px = LENS_PX[stated] if stated in LENS_PX else LENS_OF_FOCAL[stated] * float(f.mean())
    corner = 0.5 * np.array([camera.width, camera.height]) / f
    by_lens = pixels_and_derivatives(camera, mean, corner)[2][:, PINHOLE:]
    deviation = np.concatenate([FOCAL[stated] * f, [c, c], lens_px / np.linalg.norm(by_lens, axis=0)])
    if camera.model == "unified" and stated == "nominal":
        deviation[PINHOLE] = min(deviation[PINHOLE], XI_OF_NOMINAL * (1.0 + camera.D[0]))
    assert len(deviation) == PINHOLE + len(camera.D)
    return mean, deviation
