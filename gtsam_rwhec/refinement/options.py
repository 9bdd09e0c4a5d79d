"""Options of the refinement."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np

from gtsam_rwhec.errors import NoiseError, OptionError
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.problem.pairs import ByPair
from gtsam_rwhec.trajectories.trajectory import Trajectory

NoiseSource = Literal["auto", "given", "estimate"]
NoiseGroups = Literal["all", "sensor", "pair"]
ResidualKind = Literal["geodesic", "chordal"]
Robust = Literal["none", "huber", "cauchy", "tukey", "geman_mcclure", "gnc"]
CarrierModel = Literal["auto", "propagated", "variables"]
About = Literal["targetcarrier", "sensorcarrier"]


@dataclass(frozen=True)
class CarrierNoise:
    """Noise of the carrier poses A = T_sensorcarrier_targetcarrier, which kinematics and motion capture always have.

    Attributes
    ----------
    rotation_rad, translation_m : float
        Standard deviations about and along each axis, in rad and m.
    covariances : dict of (target, sensor) to (N, 6, 6) array, optional
        One for each measurement in their place, rotation first.
    about : "targetcarrier" or "sensorcarrier"
        In whose axes, and about whose origin, the perturbation is: A Expmap(xi) for the target carrier (an arm's hand
        that is off in its own frame, with A = T_base_hand), Expmap(xi) A for the sensor carrier.
    """

    rotation_rad: float = 0.0
    translation_m: float = 0.0
    covariances: ByPair[Array] | None = None
    about: About = "targetcarrier"

    def __post_init__(self) -> None:
        if self.about not in get_args(About):
            raise OptionError(
                f"CarrierNoise.about={self.about!r} is not one of {', '.join(map(repr, get_args(About)))}"
            )
        if self.covariances is not None:
            if self.rotation_rad or self.translation_m:
                raise NoiseError(
                    f"CarrierNoise has covariances and rotation_rad={self.rotation_rad!r}, "
                    f"translation_m={self.translation_m!r} too; give the one or the other"
                )
            return
        for name in ("rotation_rad", "translation_m"):
            value = getattr(self, name)
            if not (isinstance(value, (int, float)) and np.isfinite(value) and value > 0.0):
                raise NoiseError(
                    f"CarrierNoise.{name} is {value!r}; give a positive standard deviation (or no CarrierNoise at all, "
                    "if A is exact)"
                )


@dataclass(frozen=True)
class RefineOptions:
    """How to refine.

    Attributes
    ----------
    noise : "auto", "given" or "estimate"
        Of B: as the measurements' sigma, kappa or covariances say, or those times variance factors, one for rotations
        and one for translations, estimated from the residuals. "auto": given where there are weights, else estimated.
    noise_groups : "all", "sensor" or "pair"
        Whose residuals share a variance factor.
    residual : "geodesic" or "chordal"
        Log(B^-1 Y^-1 A X) with any 6 x 6 covariance, from the raw measurements; or the certified cost's own, from
        moments alone, with which GTSAM's optimum is the certified one.
    robust : "none", "huber", "cauchy", "tukey", "geman_mcclure" or "gnc"
        GTSAM's losses (95 % efficient at Gaussian noise; from the certified solution, by way of "huber", which many
        gross outliers have pulled away); or graduated truncated least squares around the certified solver, which needs
        no good start, and after which outliers are left out.
    inlier_confidence : float
        With "gnc": probability that a good measurement is kept.
    carrier_noise : CarrierNoise, optional
        Of A; left out, A is taken for exact, and where it is not, covariances are too small.
    carrier_model : "auto", "propagated" or "variables"
        A's noise carried into each residual to first order; or each A a variable, shared between the measurements of
        one stamp. "auto": variables where measurements share a stamp, else propagated, which is then the same.
    time_offsets : bool or tuple of str
        Estimate an offset of the clock of each sensor, or of those named: a stamp t is the carriers' t + offset
        (Kalibr's convention). Needs stamps.
    carrier_path : Trajectory, optional
        T_sensorcarrier_targetcarrier over time as it was logged, faster than measurements were made: time offsets move
        A along it. Left out, the measurements' own A tell how the carriers moved.
    max_iterations : int
        Levenberg-Marquardt steps.
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

    def __post_init__(self) -> None:
        for name, choices in _CHOICES.items():
            if getattr(self, name) not in get_args(choices):
                raise OptionError(
                    f"RefineOptions.{name}={getattr(self, name)!r} is not one of "
                    f"{', '.join(map(repr, get_args(choices)))}"
                )
        if not (isinstance(self.inlier_confidence, float) and 0.5 < self.inlier_confidence < 1.0):
            raise OptionError(f"RefineOptions.inlier_confidence={self.inlier_confidence!r}; give one between 0.5 and 1")
        if not isinstance(self.time_offsets, (bool, tuple)):
            raise OptionError(
                f"RefineOptions.time_offsets={self.time_offsets!r}; give True, or a tuple of sensors' names: ('cam_0',)"
            )
        if not (isinstance(self.max_iterations, int) and self.max_iterations > 0):
            raise OptionError(f"RefineOptions.max_iterations={self.max_iterations!r}; give a positive number")
        if self.carrier_noise is not None and not isinstance(self.carrier_noise, CarrierNoise):
            raise OptionError(
                f"RefineOptions.carrier_noise is a {type(self.carrier_noise).__name__}; give "
                "CarrierNoise(rotation_rad=..., translation_m=...)"
            )
        if self.carrier_path is not None and not self.time_offsets:
            raise OptionError("RefineOptions.carrier_path is for time offsets; without time_offsets it says nothing")
        if self.residual == "chordal":
            for name, value in (
                ("carrier_noise", self.carrier_noise),
                ("time_offsets", self.time_offsets),
                ("robust", None if self.robust in ("none", "gnc") else self.robust),
            ):
                if value:
                    raise OptionError(
                        f"RefineOptions.{name}={value!r} needs residual='geodesic': the chordal one is made of moments"
                    )


_CHOICES = {
    "noise": NoiseSource,
    "noise_groups": NoiseGroups,
    "residual": ResidualKind,
    "robust": Robust,
    "carrier_model": CarrierModel,
}
