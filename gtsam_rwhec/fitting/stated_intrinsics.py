"""What is known of a camera before the images are looked at: its stated parameters, and how far they may be off.

Intrinsics are stated by a calibration, or they are nominal: from a data sheet, a simulator, another camera of the same
kind. A calibration without a covariance is taken to be right to 0.3 % of the focal length and 3 pixels of the centre;
nominal intrinsics to 3 %, and to 30 pixels or 2 % of the image's width, whichever is more. Coefficients of the
lens model move the image's corner by a calibration's 3 pixels, or by a nominal 5 % of the focal length; k1 and k2 go
against each other, as those of published calibrations do (docs/lens_priors.md). Unknown ones
are right to the focal length itself and half the width: the images must say them. Exact ones are held: their
deviations are so small that no number of corners tells anything of them.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple, get_args

import numpy as np
from scipy.special import chdtrc, chdtri

from gtsam_rwhec.cameras.camera import Camera
from gtsam_rwhec.cameras.distortion import coefficient_jacobian, distorted
from gtsam_rwhec.fitting.fit_options import FreeLens, Stated
from gtsam_rwhec.geometry.poses import Array

#: fx, fy, cx, cy come before the coefficients.
PINHOLE = 4
#: Deviation of the focal length (a share), of the centre (pixels), and of the coefficients (pixels at the corner of
#: the image, or a share of the focal length).
FOCAL = {"exact": 1e-8, "calibration": 0.003, "nominal": 0.03, "unknown": 1.0}
CENTRE_PX = {"exact": 1e-5, "calibration": 3.0, "nominal": 30.0, "unknown": 30.0}
CENTRE_OF_WIDTH = {"exact": 0.0, "calibration": 0.0, "nominal": 0.02, "unknown": 0.5}
LENS_PX = {"exact": 1e-5, "calibration": 3.0}
LENS_OF_FOCAL = {"nominal": 0.05, "unknown": 0.5}
#: Nominal ones of a radtan lens with k1 and k2, and the correlation of how far these two move the image's corner.
NOMINAL_BEND, OPPOSED = {"k1": 0.079, "k2": 0.059, "k3": 0.031}, -0.86
#: Deviations of fy / fx and of p1 and p2 from what is stated; those of published calibrations: docs/lens_priors.md.
ASPECT, TANGENTIAL = 2.7e-3, 2.6e-3
#: That of fy / fx where they are one focal length. Where it is 1e-8, GTSAM's Levenberg-Marquardt takes a hundred steps.
SQUARE = 1e-6
#: A parameter that is further than this many of its prior's deviations from the mean is held: it begins at the mean.
FAR_OFF = 1e3
#: xi of a nominal unified camera is right to this share of 1 + xi. It bends the image as k1 does, but along a curve:
#: where xi is as free as the other coefficients, their linear deviations hold the truth in 78 to 88 % of simulations.
XI_OF_NOMINAL = 0.05


#: The coefficients that each `FreeLens` adds to what is free; those that none adds are free with "all".
ADDED: dict[FreeLens, tuple[str, ...]] = {
    "focal": (), "focals": (), "k1": ("xi", "k1"), "k2": ("k2",), "p2": ("p1", "p2"), "k3": ("k3",),
    "rational": ("k4", "k5", "k6"),
}  # fmt: skip


class CameraPrior(NamedTuple):
    """What is known of a camera's parameters: mean (m,), standard deviations (m,), and that of fy / fx.

    ``opposed`` are the places of k1 and k2 where these go against each other.
    """

    mean: Array
    deviation: Array
    aspect: float = np.inf
    opposed: tuple[int, ...] = ()

    @property
    def correlation(self) -> Array:
        """(m, m): Of the parameters, without the tie of fx and fy."""
        found = np.eye(len(self.mean))
        if self.opposed:
            found[self.opposed, self.opposed[::-1]] = OPPOSED
        return found

    @property
    def root(self) -> Array:
        """R (m, m), upper triangular: R'R is the covariance's inverse, without the tie. Deviations may be infinite."""
        R: Array = np.linalg.cholesky(np.linalg.inv(self.correlation)).T / self.deviation
        return R

    @property
    def tie(self) -> Array:
        """The row (m,) whose product with errors of the parameters is that of fy / fx, in its deviations."""
        row = np.zeros(len(self.mean))
        if np.isfinite(self.aspect):
            row[:2] = np.array([-1.0, 1.0]) / self.mean[:2] / self.aspect
        return row

    def start(self, parameters: Array) -> Array:
        """Parameters (m,) to begin with: the mean of those that are held."""
        return np.where(FAR_OFF * self.deviation < np.abs(parameters - self.mean), self.mean, parameters)

    @property
    def precision(self) -> Array:
        """(m, m): The inverse of the covariance."""
        found: Array = self.root.T @ self.root + np.outer(self.tie, self.tie)
        return found


def is_free(camera: Camera, lens: FreeLens) -> np.ndarray:
    """Which of a camera's parameters (m,) are free."""
    levels, names = get_args(FreeLens), camera.parameter_names
    free = {*names[:PINHOLE], *(n for level in levels[: levels.index(lens) + 1] for n in ADDED.get(level, names))}
    return np.array([name in free for name in names])


def free_model(camera: Camera, stated: Stated, lens: FreeLens = "all") -> Camera:
    """The camera with the lens model that is estimated: a pinhole may have distortion that nobody stated."""
    stays = stated == "exact" or camera.model not in ("pinhole", "radtan")
    if stays or (camera.model == "pinhole" and not ADDED.get(lens, ("k1",))):
        return camera
    number = max(len(camera.D), {"k3": 5, "rational": 8}.get(lens, 4))
    return Camera(camera.width, camera.height, "radtan", camera.K, np.pad(camera.D, (0, number - len(camera.D))))


def prior_of(camera: Camera, stated: Stated, lens: FreeLens = "all") -> CameraPrior:
    """What is known of a camera's parameters before the images, with those held that are not free."""
    mean = camera.parameters
    if stated == "unknown":  # an estimate from boards alone states nothing
        mean[:2] = mean[:2].mean()
        if camera.model == "radtan":
            mean[PINHOLE:] = 0.0
    f, c = mean[:2], max(CENTRE_PX[stated], CENTRE_OF_WIDTH[stated] * camera.width)
    lens_px = LENS_PX[stated] if stated in LENS_PX else LENS_OF_FOCAL[stated] * float(f.mean())
    corner = 0.5 * np.array([camera.width, camera.height]) / f
    bend_px = np.linalg.norm(pixels_and_derivatives(camera, mean, corner)[2][:, PINHOLE:], axis=0)
    deviation = np.concatenate([FOCAL[stated] * f, [c, c], lens_px / bend_px])
    names, free = camera.parameter_names, is_free(camera, lens)
    opposed = tuple(at for at, name in enumerate(names) if name in ("k1", "k2") and free[at])
    if camera.model != "radtan" or stated not in ("nominal", "calibration") or len(opposed) < 2:
        opposed = ()
    elif stated == "nominal":
        share = np.array([NOMINAL_BEND.get(name, LENS_OF_FOCAL[stated]) for name in names[PINHOLE:]])
        deviation[PINHOLE:] *= share / LENS_OF_FOCAL[stated]
    if camera.model == "unified" and stated == "nominal":
        deviation[PINHOLE] = min(deviation[PINHOLE], XI_OF_NOMINAL * (1.0 + camera.D[0]))
    assert len(deviation) == PINHOLE + len(camera.D)
    if stated == "exact":
        return CameraPrior(mean, deviation)
    for at in (at for at, name in enumerate(names) if name in ("p1", "p2")):
        deviation[at] = min(deviation[at], TANGENTIAL)
    held = ~free[PINHOLE:]
    deviation[PINHOLE:][held] = LENS_PX["exact"] / bend_px[held]
    return CameraPrior(mean, deviation, SQUARE if lens == "focal" else ASPECT, opposed)


#: Directions count in which the images say at least this share of what the prior and the images say together.
TOLD = 0.05
#: The parts of a camera's parameters, which are stated well or badly for reasons of their own. Each is tested alone:
#: among all parameters together a centre that is off by three deviations drowns.
PARTS = {"focal length": slice(0, 2), "centre": slice(2, PINHOLE), "distortion": slice(PINHOLE, None)}
#: A stated part is contradicted where chance gives such an innovation with less than this probability; where it does
#: so with less than the second, its deviations are widened all the same.
CONTRADICTED, DOUBTED = 0.0025, 0.05
#: By so many times: what is contradicted is off as nominal intrinsics are, and no calibration's.
WIDER_CONTRADICTED, WIDER_DOUBTED = 10.0, 3.0
#: A direction is held by the prior where its posterior deviation is above this share of the prior's.
HELD = 0.7


@dataclass(frozen=True, eq=False)
class Innovation:
    """What the images say against stated intrinsics."""

    #: (m,): Estimated less stated parameters.
    off: Array
    #: That chance gives as much, by part ("focal length", "centre", "distortion").
    probabilities: Mapping[str, float]

    @property
    def probability(self) -> float:
        """That chance gives one part as much: Bonferroni's bound."""
        return min(1.0, len(self.probabilities) * min(self.probabilities.values()))

    @property
    def deviations(self) -> float:
        """How far off the worst part is, as deviations of one normal number with the same probability."""
        return deviations_of(min(self.probabilities.values()))

    @property
    def contradicted(self) -> tuple[str, ...]:
        """The parts that chance does not explain."""
        return tuple(part for part, probability in self.probabilities.items() if probability < CONTRADICTED)

    @property
    def doubted(self) -> tuple[str, ...]:
        """The parts that chance hardly explains, or not at all."""
        return tuple(part for part, probability in self.probabilities.items() if probability < DOUBTED)

    @property
    def is_contradicted(self) -> bool:
        """Whether chance does not explain a part."""
        return bool(self.contradicted)


def deviations_of(probability: float) -> float:
    """The deviations that a normal number exceeds with a probability, either way."""
    return float(np.sqrt(chdtri(1.0, max(probability, 1e-300))))


def innovation_of(estimate: Array, prior: CameraPrior, posterior: Array) -> Innovation:
    """The test of estimated parameters (m,) against the stated ones, with their posterior covariance (m, m)."""
    off, R = estimate - prior.mean, prior.root
    return Innovation(
        off, {part: chance_of(off[at], R[at, at], posterior[at, at]) for part, at in PARTS.items() if len(off[at])}
    )


def chance_of(off: Array, R: Array, posterior: Array) -> float:
    """The probability that chance gives as much; `off` (m,), the prior's root and the posterior, (m, m).

    Before the images, R `off` has the covariance 1 - R posterior R': z^2 of its principal parts is chi-square.
    """
    covariance = np.eye(len(off)) - R @ posterior @ R.T
    values, vectors = np.linalg.eigh(0.5 * (covariance + covariance.T))
    told = values > TOLD
    if not told.any():
        return 1.0
    z2 = float(((vectors.T @ (R @ off))[told] ** 2 / values[told]).sum())
    return float(chdtrc(told.sum(), z2))


def wider(prior: CameraPrior, innovation: Innovation) -> CameraPrior:
    """The prior, wider for the parts that are doubted."""
    deviation = prior.deviation.copy()
    for part in innovation.doubted:
        deviation[PARTS[part]] *= WIDER_CONTRADICTED if part in innovation.contradicted else WIDER_DOUBTED
    return prior._replace(deviation=deviation)


def held_by_prior(R: Array, posterior: Array) -> np.ndarray:
    """Which parameters (m,) only the prior holds: alone, or in a direction that the images do not tell.

    A focal length that only the prior holds leaves fx and fy each a deviation that is smaller than the prior's, since
    the images tell that they are equal. So principal directions are asked, in the prior's deviations; a direction
    names the parameters that have half of its largest part and more. ``R`` (m, m) is the prior's root.
    """
    scaled = R @ posterior @ R.T
    values, vectors = np.linalg.eigh(0.5 * (scaled + scaled.T))
    parts = np.abs(vectors[:, values > HELD**2])
    of_directions = (parts >= 0.5 * parts.max(axis=0, initial=0.0)).any(axis=1)
    return np.asarray(of_directions | (np.diagonal(scaled) > HELD**2))


def pixels_and_derivatives(camera: Camera, parameters: Array, x: Array) -> tuple[Array, Array, Array]:
    """Pixels (..., 2) of normalised coordinates (..., 2), with derivatives (..., 2, 2) by x and by the parameters."""
    camera = camera.with_parameters(parameters)
    f, c, D = np.diagonal(camera.K)[:2], camera.K[:2, 2], camera.D
    bent, by_x = distorted(camera.model, D, x)
    by_parameters = np.zeros((*x.shape[:-1], 2, len(parameters)))
    by_parameters[..., 0, 0], by_parameters[..., 1, 1] = bent[..., 0], bent[..., 1]
    by_parameters[..., 0, 2] = by_parameters[..., 1, 3] = 1.0
    if len(D):
        by_parameters[..., PINHOLE:] = f[:, None] * coefficient_jacobian(camera.model, D, x)
    if camera.model == "unified":  # f is a parameter times 1 + xi
        by_parameters[..., :2] *= 1.0 + D[0]
        by_parameters[..., PINHOLE] += bent * parameters[:2]
    return f * bent + c, f[:, None] * by_x, by_parameters
