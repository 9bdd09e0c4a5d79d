"""The options of a refinement, and the noise of carrier poses."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np

from gtsam_rwhec.errors import NoiseError, OptionError
from gtsam_rwhec.files.terminal_text import brief
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.geometry.real_numbers import LARGEST_WHOLE, is_one_of, is_real, is_whole
from gtsam_rwhec.problem.pairs import ByPair
from gtsam_rwhec.trajectories.trajectory import Trajectory

NoiseSource = Literal["auto", "given", "estimate"]
NoiseGroups = Literal["all", "sensor", "pair"]
ResidualKind = Literal["geodesic", "chordal"]
Robust = Literal["none", "huber", "cauchy", "tukey", "geman_mcclure", "gnc"]
CarrierModel = Literal["auto", "propagated", "variables"]
About = Literal["targetcarrier", "sensorcarrier"]
ObservationKind = Literal["poses", "corners"]


@dataclass(frozen=True)
class CarrierNoise:
    """Noise of the carrier poses A = T_sensorcarrier_targetcarrier, from kinematics or motion capture.

    Attributes
    ----------
    rotation_rad, translation_m : float
        Standard deviations about each axis, rad, and along each axis, m.
    covariances : dict of (target, sensor) to (N, 6, 6) array, optional
        A covariance for each measurement, in place of the standard deviations; rotation first.
    about : "targetcarrier" or "sensorcarrier"
        The carrier whose axes and origin the perturbation has: A Expmap(xi) for the target carrier (the error of an
        arm's hand in its own frame, with A = T_base_hand), Expmap(xi) A for the sensor carrier.
    """

    rotation_rad: float = 0.0
    translation_m: float = 0.0
    covariances: ByPair[Array] | None = None
    about: About = "targetcarrier"

    def __post_init__(self) -> None:
        if not is_one_of(self.about, get_args(About)):
            raise OptionError(
                f"CarrierNoise.about={brief(self.about)} is not one of {', '.join(map(repr, get_args(About)))}"
            )
        if self.covariances is not None:
            if self.rotation_rad or self.translation_m:
                raise NoiseError(
                    f"CarrierNoise has covariances, and also rotation_rad={self.rotation_rad!r} and "
                    f"translation_m={self.translation_m!r}; give covariances or standard deviations, not both"
                )
            return
        for name in ("rotation_rad", "translation_m"):
            value = getattr(self, name)
            if not (is_real(value) and 0.0 < value <= np.finfo(np.float64).max):
                raise NoiseError(
                    f"CarrierNoise.{name} is {brief(value)}; give a positive standard deviation (or no CarrierNoise at "
                    "all, if A is exact)"
                )


@dataclass(frozen=True)
class RefineOptions:
    """The options of ``refine``.

    Attributes
    ----------
    noise : "auto", "given" or "estimate"
        The noise of B. "given": the measurements' sigma, kappa or covariances. "estimate": these times variance
        factors, one for rotations and one for translations, estimated from the residuals. "auto": given if there are
        weights, else estimated.
    noise_groups : "all", "sensor" or "pair"
        The groups of residuals that share a variance factor.
    residual : "geodesic" or "chordal"
        "geodesic": Log(B^-1 Y^-1 A X) with any 6 x 6 covariance, from the raw measurements. "chordal": the certified
        cost's residual, from moments alone; then GTSAM's optimum is the certified optimum.
    robust : "none", "huber", "cauchy", "tukey", "geman_mcclure" or "gnc"
        GTSAM's losses start at the certified solution, by way of "huber", and have 95 % efficiency for Gaussian noise.
        Many gross outliers pull this start away. "gnc" is graduated truncated least squares around the certified
        solver. It needs no good start, and leaves outliers out.
    inlier_confidence : float
        With "gnc": probability that a good measurement is kept, at least: all good ones together are kept with 95 %.
    carrier_noise : CarrierNoise, optional
        The noise of A. Without it A counts as exact; if A is not exact, covariances are then too small.
    carrier_model : "auto", "propagated" or "variables"
        "propagated": A's noise is propagated into each residual to first order. "variables": each A is a variable,
        shared by the measurements of one stamp. "auto": variables if measurements share a stamp; else propagated, which
        is then the same.
    time_offsets : bool or tuple of str
        Estimate the clock offset of each sensor, or of the named sensors: a sensor's stamp t is the carriers' t +
        offset (Kalibr's convention). The measurements need stamps.
    carrier_path : Trajectory, optional
        T_sensorcarrier_targetcarrier over time, logged faster than the measurements were made. Time offsets move A
        along this path. Without it the measurements' own A give the carriers' motion.
    max_iterations : int
        Largest number of Levenberg-Marquardt steps.
    observations : "poses" or "corners"
        What is refined from: the measured poses B, or, from there on, the corners of the images that the problem holds
        (``problem.add_corners``). The other options are then those of the poses, of which outliers among images are
        left out too (``robust="gnc"``); ``rw.CornerOptions`` has those of the corners.
    """

    noise: NoiseSource = "auto"
    noise_groups: NoiseGroups = "all"
    residual: ResidualKind = "geodesic"
    robust: Robust = "none"
    inlier_confidence: float = 0.997
    carrier_noise: CarrierNoise | None = None
    carrier_model: CarrierModel = "auto"
    time_offsets: bool | tuple[str, ...] = False
    carrier_path: Trajectory | None = None
    max_iterations: int = 100
    observations: ObservationKind = "poses"

    def __post_init__(self) -> None:
        for name, choices in _CHOICES.items():
            if not is_one_of(getattr(self, name), get_args(choices)):
                raise OptionError(
                    f"RefineOptions.{name}={brief(getattr(self, name))} is not one of "
                    f"{', '.join(map(repr, get_args(choices)))}"
                )
        if not (isinstance(self.inlier_confidence, float) and 0.5 < self.inlier_confidence < 1.0):
            raise OptionError(
                f"RefineOptions.inlier_confidence={brief(self.inlier_confidence)}; give one between 0.5 and 1"
            )
        if not isinstance(self.time_offsets, (bool, tuple)):
            raise OptionError(
                f"RefineOptions.time_offsets={brief(self.time_offsets)}; give True, or a tuple of sensors' names: "
                "('cam_0',)"
            )
        if not is_whole(self.max_iterations, 1):
            raise OptionError(
                f"RefineOptions.max_iterations={brief(self.max_iterations)}; give a whole number from 1 to "
                f"{LARGEST_WHOLE}"
            )
        if self.carrier_noise is not None and not isinstance(self.carrier_noise, CarrierNoise):
            raise OptionError(
                f"RefineOptions.carrier_noise is a {type(self.carrier_noise).__name__}; give "
                "CarrierNoise(rotation_rad=..., translation_m=...)"
            )
        if self.carrier_path is not None and not self.time_offsets:
            raise OptionError("RefineOptions.carrier_path has no use without time_offsets; give time_offsets too")
        if self.residual == "chordal":
            for name, value in (
                ("carrier_noise", self.carrier_noise),
                ("time_offsets", self.time_offsets),
                ("robust", None if self.robust in ("none", "gnc") else self.robust),
            ):
                if value:
                    raise OptionError(
                        f"RefineOptions.{name}={value!r} needs residual='geodesic'; the chordal one has moments only"
                    )


_CHOICES = {
    "noise": NoiseSource,
    "noise_groups": NoiseGroups,
    "residual": ResidualKind,
    "robust": Robust,
    "carrier_model": CarrierModel,
    "observations": ObservationKind,
}
