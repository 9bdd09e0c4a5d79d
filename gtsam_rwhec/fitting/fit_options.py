"""The options of a refinement, and the noise of carrier poses."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Any, Literal, NamedTuple, get_args

import numpy as np

from gtsam_rwhec.errors import NoiseError, OptionError
from gtsam_rwhec.files.terminal_text import brief
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.geometry.real_numbers import LARGEST_WHOLE, check_kind, is_one_of, is_real, is_whole
from gtsam_rwhec.geometry.trajectory import Trajectory
from gtsam_rwhec.problem.measurements import ByPair

NoiseSource = Literal["auto", "given", "estimate"]
NoiseGroups = Literal["all", "sensor", "pair"]
ResidualKind = Literal["geodesic", "chordal"]
Robust = Literal["none", "huber", "cauchy", "tukey", "geman_mcclure", "gnc"]
CarrierModel = Literal["auto", "propagated", "variables"]
About = Literal["targetcarrier", "sensorcarrier"]
ObservationKind = Literal["poses", "corners"]
Stated = Literal["exact", "calibration", "nominal", "unknown"]
#: What is free of a camera, each with what comes before it: one focal length and the centre; fx and fy apart; and the
#: coefficients of the lens in this order. "all": what its lens model has.
FreeLens = Literal["focal", "focals", "k1", "k2", "p2", "k3", "rational", "all"]


@dataclass(frozen=True)
class CarrierNoise:
    """Noise of the carrier poses A = T_sensorcarrier_targetcarrier, from kinematics or motion capture."""

    #: Standard deviations about each axis, rad, and along each axis, m.
    rotation_rad: float = 0.0
    translation_m: float = 0.0
    #: (N, 6, 6) each. A covariance for each measurement, in place of the standard deviations; rotation first.
    covariances: ByPair[Array] | None = None
    #: The carrier whose axes and origin the perturbation has: A Expmap(xi) for the target carrier (the error of an
    #: arm's hand in its own frame, with A = T_base_hand), Expmap(xi) A for the sensor carrier.
    about: About = "targetcarrier"

    def __post_init__(self) -> None:
        check_choices(self, {"about": About})
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
class ArmAccuracy:
    """How far off an arm's poses are, alike at poses that are near each other: no residual shows most of it.

    It is what calibrations of arms or data sheets call absolute accuracy, not repeatability.
    """

    #: Standard deviations about each axis, rad, and along each axis, m.
    rotation_rad: float
    translation_m: float

    def __post_init__(self) -> None:
        for name in ("rotation_rad", "translation_m"):
            value = getattr(self, name)
            if not (is_real(value) and 0.0 < value <= np.finfo(np.float64).max):
                raise NoiseError(f"ArmAccuracy.{name} is {brief(value)}; give a positive standard deviation")


def check_choices(options: object, choices: Mapping[str, Any]) -> None:
    """OptionError for an option, by name, that is none of the words of its Literal."""
    for name, words in choices.items():
        value = getattr(options, name)
        if not is_one_of(value, get_args(words)):
            raise OptionError(
                f"{type(options).__name__}.{name}={brief(value)} is not one of {', '.join(map(repr, get_args(words)))}"
            )


@dataclass(frozen=True)
class PoseOptions:
    """Options that ``refine`` and ``calibrate`` share."""

    #: The noise of B. "given": the measurements' sigma, kappa or covariances. "estimate": from the residuals; what is
    #: stated gives the ratios. "auto": ``refine`` takes what is given if there are weights, else it estimates;
    #: ``calibrate`` estimates, and takes what is given where the residuals are too few.
    noise: NoiseSource = "auto"
    #: The measurements that share an estimate of the noise.
    noise_groups: NoiseGroups = "all"
    #: Probability that a good measurement is kept, at least: all good ones together are kept with 95 %.
    inlier_confidence: float = 0.997
    #: The noise of A, if you know it. Without it A counts as exact in ``refine``; if A is not exact, covariances are
    #: then too small. ``calibrate`` estimates it.
    carrier_noise: CarrierNoise | None = None
    #: T_sensorcarrier_targetcarrier over time, logged faster than the measurements were made. Time offsets move A along
    #: this path. Without it the measurements' own A give the carriers' motion.
    carrier_path: Trajectory | None = None

    def __post_init__(self) -> None:
        check_choices(self, {"noise": NoiseSource, "noise_groups": NoiseGroups})
        self.check_share("inlier_confidence", 0.5)
        own, noise = type(self).__name__, "CarrierNoise(rotation_rad=..., translation_m=...)"
        check_kind(self.carrier_noise, CarrierNoise | None, f"{own}.carrier_noise", noise)
        check_kind(self.carrier_path, Trajectory | None, f"{own}.carrier_path", "a Trajectory")

    def check_share(self, name: str, least: float) -> None:
        """OptionError for an option that is no number between a least one and 1."""
        value = getattr(self, name)
        if not (is_real(value) and least < value < 1.0):
            raise OptionError(f"{type(self).__name__}.{name}={brief(value)}; give one between {least:g} and 1")


@dataclass(frozen=True)
class RefineOptions(PoseOptions):
    """The options of ``refine``."""

    #: "geodesic": Log(B^-1 Y^-1 A X) with any 6 x 6 covariance, from the raw measurements. "chordal": the certified
    #: cost's residual, from moments alone; then GTSAM's optimum is the certified optimum.
    residual: ResidualKind = "geodesic"
    #: GTSAM's losses start at the certified solution, by way of "huber", and have 95 % efficiency for Gaussian noise.
    #: Many gross outliers pull this start away. "gnc" is graduated truncated least squares around the certified solver.
    #: It needs no good start, and leaves outliers out.
    robust: Robust = "none"
    #: "propagated": A's noise is propagated into each residual to first order. "variables": each A is a variable,
    #: shared by the measurements of one stamp. "auto": variables if measurements share a stamp; else propagated, which
    #: is then the same.
    carrier_model: CarrierModel = "auto"
    #: Estimate the clock offset of each sensor, or of the named sensors: a sensor's stamp t is the carriers' t + offset
    #: (Kalibr's convention). The measurements need stamps.
    time_offsets: bool | tuple[str, ...] = False
    #: Largest number of the optimiser's steps.
    max_iterations: int = 100
    #: The data of the refinement: the measured poses B, or, starting from their result, the corners of the problem's
    #: images (``problem.add_corners``). The other options are then those of the poses, of which outliers among images
    #: are left out too (``robust="gnc"``); ``rw.CornerOptions`` has those of the corners.
    observations: ObservationKind = "poses"

    def __post_init__(self) -> None:
        super().__post_init__()
        check_choices(
            self,
            {
                "residual": ResidualKind,
                "robust": Robust,
                "carrier_model": CarrierModel,
                "observations": ObservationKind,
            },
        )
        if not isinstance(self.time_offsets, (bool, tuple)):
            raise OptionError(
                f"RefineOptions.time_offsets={brief(self.time_offsets)}; give True, or a tuple of sensors' names: "
                "('cam_0',)"
            )
        check_iterations(self, self.max_iterations)
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


def check_iterations(options: object, number: object) -> None:
    """OptionError for a limit of iterations that is no whole number."""
    if not is_whole(number, 1):
        raise OptionError(
            f"{type(options).__name__}.max_iterations={brief(number)}; give a whole number from 1 to {LARGEST_WHOLE}"
        )


class Component(StrEnum):
    """A kind of noise; the unit is that of its standard deviation."""

    #: B's rotation about each axis, rad (a factor, where covariances are stated).
    ROTATION = "rotation of B"
    #: B's translation along each axis, m (a factor, where covariances are stated).
    TRANSLATION = "translation of B"
    #: B's translation along the sensor's z axis, on top, m.
    DEPTH = "depth of B"
    #: A's rotation about each axis, rad.
    CARRIER_ROTATION = "rotation of A"
    #: A's translation along each axis, m.
    CARRIER_TRANSLATION = "translation of A"
    #: Jitter of clocks, s.
    JITTER = "jitter"
    #: Drift of a sensor's track in a step: rotation, rad.
    DRIFT_ROTATION = "drift of rotation"
    #: Drift in a step: translation, m.
    DRIFT_TRANSLATION = "drift of translation"
    #: Drift in a step: logarithm of the scale.
    DRIFT_SCALE = "drift of scale"
    #: Errors of the carriers' poses that vary with the configuration: rotation, rad.
    SYSTEMATIC_ROTATION = "systematic rotation of A"
    #: The same: translation, m.
    SYSTEMATIC_TRANSLATION = "systematic translation of A"


C = Component
WHITE = (C.ROTATION, C.TRANSLATION, C.DEPTH)
CARRIER = (C.CARRIER_ROTATION, C.CARRIER_TRANSLATION)
DRIFT = (C.DRIFT_ROTATION, C.DRIFT_TRANSLATION, C.DRIFT_SCALE)
SYSTEMATIC = (C.SYSTEMATIC_ROTATION, C.SYSTEMATIC_TRANSLATION)

#: Whose frame an error is made in; "detection": rotations in the target's axes, translations along the sensor's. In a
#: carrier's frame it is an error of A, which all tracks share.
DriftFrame = Literal["sensor", "target", "detection", "targetcarrier", "sensorcarrier"]


class Walk(NamedTuple):
    """A kind of drift: the correlation of errors from step to step (1: a random walk), and whose frame they are in."""

    correlation: float
    frame: DriftFrame

    @property
    def is_of_a_trajectory(self) -> bool:
        """Whether each step errs on its own, where the frame is: as odometry's and SLAM's do."""
        return self.correlation == 1.0 and self.frame != "detection"

    @property
    def is_shared(self) -> bool:
        """Whether all tracks share it."""
        return self.frame in get_args(About)


#: Whether a track drifts: "auto" (the data decide), a random walk, errors with a correlation time, or neither.
Drift = Literal["auto", "walk", "correlated", "none"]


@dataclass(frozen=True)
class NoiseOptions:
    """The options of ``modelled``; each one overrules a choice that the data make."""

    #: Standard deviations that are known. Those of B are factors of the covariances that the problem states.
    stated: dict[Component, float] = field(default_factory=dict)
    #: Whether A has noise.
    carrier: bool = True
    #: Whether A has errors that vary smoothly with the configuration.
    systematic: bool = True
    #: "auto": as the residuals' correlation in time shows. A ``Walk``: this kind, which was found before.
    drift: Drift | Walk = "auto"
    #: The carrier that A's errors are fixed to, such as a hand. None: the data decide.
    side: About | None = None


CarrierPoses = Literal["exact", "estimate"]


@dataclass(frozen=True)
class CornerOptions:
    """The options of `refine_corners`."""

    #: Where the stated intrinsics come from. A calibration's are right to 0.3 % of f and 3 pixels of c, nominal ones to
    #: 3 % and to 30 pixels or 2 % of the width; unknown ones are estimated from the images alone, and exact ones are
    #: fixed. Sensors that a dict lacks are nominal. Where the images contradict what is stated, the deviation is
    #: widened, and the result says so.
    stated: Stated | Mapping[str, Stated] = "nominal"
    #: What is free of each camera's intrinsics; the rest is held as stated. Sensors that a dict lacks have all free.
    #: ``calibrate`` chooses it: the simplest camera that predicts images that were left out.
    lens: FreeLens | Mapping[str, FreeLens] = "all"
    #: Groups of sensors whose intrinsics are the same: those of the group's first sensor are stated.
    shared: tuple[tuple[str, ...], ...] = field(default=())
    #: Standard deviation of the targets' sizes, a share of 1; 0: they are exactly as stated, as are those of targets
    #: that a dict lacks.
    size_share: float | Mapping[str, float] = 0.0
    #: Standard deviation of the height of a bent board's edge over its middle, metres; 0: it is flat, as are targets
    #: that a dict lacks. ``calibrate`` chooses between flat and bent where this is 0.
    warp_m: float | Mapping[str, float] = 0.0
    #: Standard deviation of each corner's place on its board along each axis, metres, such as a printer's 1e-4; 0: they
    #: are where the board has them. With n corners there are 3n more unknowns: time grows with their square.
    corners_m: float = 0.0
    #: Standard deviation of a bias that all corners share as the detector finds them, pixels. `calibrate` counts it.
    bias_px: float | Mapping[str, float] = 0.004
    #: The noise of the carriers' poses A: given (standard deviations), estimated, or none.
    carrier_noise: CarrierNoise | CarrierPoses = "estimate"
    #: The carrier whose axes and origin A's noise has, where it is estimated: the one that moves.
    about: About = "targetcarrier"
    #: Sensors whose clock's offset is free: images were taken that long after the times of their A, at which the views
    #: have the carriers' velocity (`Views.twist`). A prior of 1 s about no offset keeps it finite. Offsets above some
    #: milliseconds want A taken at the new time, and another refinement. A rolling shutter, whose rows are seen one
    #: after the other, is not modelled: an offset is that of the mean row.
    time_offsets: tuple[str, ...] = ()
    #: Leave corners out that disagree with all others.
    outliers: bool = True
    #: Largest number of steps of one round.
    max_iterations: int = 100

    def __post_init__(self) -> None:
        check_choices(self, {"about": About})
        for value in self.stated.values() if isinstance(self.stated, Mapping) else (self.stated,):
            if not is_one_of(value, get_args(Stated)):
                raise OptionError(
                    f"CornerOptions.stated={brief(value)} is not one of {', '.join(map(repr, get_args(Stated)))}"
                )
        for lens in self.lens.values() if isinstance(self.lens, Mapping) else (self.lens,):
            if not is_one_of(lens, get_args(FreeLens)):
                raise OptionError(
                    f"CornerOptions.lens={brief(lens)} is not one of {', '.join(map(repr, get_args(FreeLens)))}"
                )
        shares = self.size_share.values() if isinstance(self.size_share, Mapping) else (self.size_share,)
        warps = self.warp_m.values() if isinstance(self.warp_m, Mapping) else (self.warp_m,)
        biases = self.bias_px.values() if isinstance(self.bias_px, Mapping) else (self.bias_px,)
        others = (*(("warp_m", each) for each in warps), ("corners_m", self.corners_m))
        others += tuple(("bias_px", each) for each in biases)
        for name, deviation in (*(("size_share", each) for each in shares), *others):
            if not (is_real(deviation) and 0.0 <= deviation < np.inf):
                raise OptionError(f"CornerOptions.{name}={brief(deviation)}; give a standard deviation, or 0")
        noise = self.carrier_noise
        if not isinstance(noise, CarrierNoise) and not is_one_of(noise, get_args(CarrierPoses)):
            raise OptionError(
                f"CornerOptions.carrier_noise={brief(noise)}; give CarrierNoise(rotation_rad=..., translation_m=...), "
                "'estimate' or 'exact'"
            )
        if isinstance(noise, CarrierNoise) and noise.covariances is not None:
            raise OptionError("CornerOptions.carrier_noise has covariances; give rotation_rad and translation_m")
        offsets = self.time_offsets
        if not (isinstance(offsets, tuple) and all(isinstance(name, str) for name in offsets)):
            raise OptionError(
                f"CornerOptions.time_offsets={brief(offsets)}; give a tuple of sensors' names, such as ('cam_0',)"
            )
        check_iterations(self, self.max_iterations)

    def stated_of(self, sensor: str) -> Stated:
        """Where a sensor's intrinsics come from."""
        return self.stated.get(sensor, "nominal") if isinstance(self.stated, Mapping) else self.stated

    def lens_of(self, sensor: str) -> FreeLens:
        """What is free of a sensor's intrinsics."""
        return self.lens.get(sensor, "all") if isinstance(self.lens, Mapping) else self.lens

    def size_share_of(self, target: str) -> float:
        """The standard deviation of a target's size, a share of 1."""
        return self.size_share.get(target, 0.0) if isinstance(self.size_share, Mapping) else self.size_share

    def warp_m_of(self, target: str) -> float:
        """The standard deviation of a target's bend, metres."""
        return self.warp_m.get(target, 0.0) if isinstance(self.warp_m, Mapping) else self.warp_m

    def bias_px_of(self, target: str) -> float:
        """The standard deviation of the bias of a target's corners, pixels; 0.004 where a dict lacks it."""
        if isinstance(self.bias_px, Mapping):
            return self.bias_px.get(target, CornerOptions.bias_px)  # type: ignore[arg-type]
        return self.bias_px

    def camera_of(self, sensor: str) -> str:
        """The sensor whose intrinsics this sensor has: its own, or the first one's of its group."""
        return next((group[0] for group in self.shared if sensor in group), sensor)
