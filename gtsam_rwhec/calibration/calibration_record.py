"""The calibration that ``calibrate`` returns: the poses to use, the verdict, and everything that was found."""

from __future__ import annotations

from dataclasses import dataclass, field

import gtsam
from numpy.typing import ArrayLike

from gtsam_rwhec.calibration.calibrate_options import CalibrateOptions
from gtsam_rwhec.calibration.misreadings import Misreading
from gtsam_rwhec.calibration.noise_choice import NoiseFound
from gtsam_rwhec.calibration.outliers import Outliers, contradicted_frames
from gtsam_rwhec.calibration.point_uncertainty import Carriers, PointUncertainty, SensorView, point_uncertainty
from gtsam_rwhec.calibration.sizes import TargetSize
from gtsam_rwhec.calibration.trial_fits import Implausible
from gtsam_rwhec.calibration.verdict import REFINEMENT, Choice, Finding, Judgement, Verdict
from gtsam_rwhec.errors import UnderdeterminedError
from gtsam_rwhec.files.terminal_text import natural_key
from gtsam_rwhec.fitting.fit_options import CarrierNoise
from gtsam_rwhec.fitting.refined import Refined
from gtsam_rwhec.fitting.unknowns import Unknown
from gtsam_rwhec.geometry.poses import Array, PoseLike
from gtsam_rwhec.problem.problem import Problem
from gtsam_rwhec.solver.solution import Solution


@dataclass(frozen=True)
class Calibration:
    """The result of ``calibrate``."""

    #: The poses to use: T_targetcarrier_target and T_sensorcarrier_sensor, metres. They are the refined ones if there
    #: are any, else the certified ones.
    X: dict[str, gtsam.Pose3]
    Y: dict[str, gtsam.Pose3]
    scale: float | dict[str, float]  #: Measured length / true length
    time_offsets_s: dict[str, float]  #: By sensor, if estimated: the sensor's stamp t is the carriers' t + offset
    judgement: Judgement  #: The verdict with its grounds; ``str()`` is one sentence
    #: The certified solution of the measurements that were kept. None where there is no answer with a positive scale;
    #: then there are no poses either.
    solution: Solution | None
    #: The refined calibration: graph, values, joint covariance. None if it could not be made, or was not because the
    #: measurements were misread; ``choices`` say why.
    refined: Refined | None
    noise: NoiseFound  #: The noise that was found
    outliers: Outliers  #: The measurements that were left out
    #: Likely mistakes in the reading of A and B, each with its cure; two or more fit alike
    misreadings: tuple[Misreading, ...]
    implausible: Implausible | None  #: Residuals that no sensor has
    sizes: tuple[TargetSize, ...]  #: What the motion says about sizes that were said to be known
    #: Mistakes in the reading of A and B that would change no residual: no data can show them
    cannot_tell: tuple[str, ...]
    findings: tuple[Finding, ...]  #: What was found against the poses besides what certificate and free directions say
    choices: tuple[Choice, ...]  #: Every choice, with its evidence
    notes: tuple[str, ...]  #: Warnings on the way that change no choice
    views: dict[str, SensorView] = field(repr=False)  #: Where each sensor saw its targets
    carriers: Carriers
    options: CalibrateOptions = field(repr=False)
    #: The measurements that were calibrated: A at the clocks' offsets where it was taken again along a path, poses of
    #: targets by the intrinsics that count, and sizes that are estimated in place of stated ones
    problem: Problem = field(repr=False)

    @property
    def verdict(self) -> Verdict:
        """What to do with the poses."""
        return self.judgement.verdict

    @property
    def verdict_reason(self) -> str:
        """Why, and what to do about it."""
        return self.judgement.reason

    @property
    def contradicted(self) -> tuple[str, ...]:
        """Sensors and targets whose own measurements contradict the answer, for the most part: not to be used."""
        return tuple(one.frame for one in contradicted_frames(self.outliers.counts))

    def __str__(self) -> str:
        lines = [str(self.judgement), *map(str, self.points.values()), *map(str, self.choices)]
        return "\n".join(lines)

    # -- covariances --------------------------------------------------------------------------------------------

    def covariance(self, *names: str | Unknown) -> Array:
        """As ``Refined.covariance``; an UnderdeterminedError where there is no refined calibration.

        Where the noise was estimated, the ellipsoid of a probability is that of an F quantile, which is wider than the
        chi-square quantile: xi' covariance^-1 xi <= ``squared_radius(dimension, confidence)``.
        """
        return self._known().covariance(*names)

    def standard_deviations(self, name: str) -> tuple[Array, Array]:
        """As ``Refined.standard_deviations``: (3,) degrees and (3,) millimetres, about and along the frame's axes."""
        return self._known().standard_deviations(name)

    def relative(self, first: str, second: str) -> tuple[gtsam.Pose3, Array]:
        """As ``Refined.relative``: T_first_second, and the covariance (6, 6) of its right perturbation."""
        return self._known().relative(first, second)

    def squared_radius(self, dimension: int = 6, confidence: float = 0.95) -> float:
        """As ``Refined.squared_radius``: a chi-square quantile, or dimension times an F quantile.

        The F quantile is that of ``refined.degrees_of_freedom``, where the noise was estimated.
        """
        return self._known().squared_radius(dimension, confidence)

    def contains(self, name: str, T_carrier_frame: PoseLike, confidence: float = 0.95) -> bool:
        """As ``Refined.contains``: whether a pose is inside a frame's confidence ellipsoid."""
        return self._known().contains(name, T_carrier_frame, confidence)

    def _known(self) -> Refined:
        if self.refined is None:
            why = next((str(choice) for choice in self.choices if choice.what == REFINEMENT), "")
            raise UnderdeterminedError(f"this calibration has no covariances. {why}")
        return self.refined

    # -- task units ---------------------------------------------------------------------------------------------

    @property
    def points(self) -> dict[str, PointUncertainty]:
        """By sensor: how far off a point is where the sensor typically saw its targets, in its carrier's frame."""
        if self.refined is None:
            return {}
        return {
            name: self.uncertainty_at(self.views[name].point_m, name, level=self.options.level)
            for name in sorted(self.views, key=natural_key)
            if name in self.Y
        }

    def uncertainty_at(
        self,
        point: ArrayLike,
        frame: str,
        seen_from: str | None = None,
        level: float = 0.95,
        *,
        A: PoseLike | None = None,
    ) -> PointUncertainty:
        """How far off a point is that is seen in one frame and expressed in another.

        Parameters
        ----------
        point : (3,)
            The point in ``frame``, metres: what a camera sees 0.8 m in front of it is [0, 0, 0.8].
        frame : str
            A sensor or a target.
        seen_from : str, optional
            Where the point is expressed: the carrier of ``frame`` (the default), or another sensor or target on the
            same carrier; with ``A`` the other carrier (the default then), or a frame on it. A carrier has the name that
            the problem states. Where it states none, "sensorcarrier", "hand" and "rig" mean the carrier of a sensor,
            and "targetcarrier", "base" and "world" that of a target. With ``A`` these words, and "hand" and "base" of
            either, mean the other carrier.
        level : float
            Probability of the ellipsoid and of the ball.
        A : (4, 4) array or gtsam.Pose3, optional
            T_sensorcarrier_targetcarrier at the moment of the measurement: what a camera on a hand sees, in the base's
            frame. Its own noise is part of ``measurement_mm``, where it is known; ``radius_mm`` takes it as exact.

        Raises
        ------
        FrameError
            There is no such frame, or the two are not on one carrier and there is no ``A``; the message lists what
            there is. Or it is not clear which carrier is meant: "base" for a sensor, where the problem names none.
        OptionError
            ``A`` is given for two frames on one carrier.
        PoseError
            The point is not three numbers, or it is behind a sensor that saw every target in front of it; ``A`` is no
            pose.
        UnderdeterminedError
            There is no refined calibration, and so no covariance.
        """
        noise = {pair: sigma for pair, sigma in self.noise.translation_m.items() if not pair.is_motion}
        return point_uncertainty(
            self._known(),
            self.views,
            noise,
            self.noise_of_A,
            self.carriers,
            point,
            frame=frame,
            seen_from=seen_from,
            level=level,
            A=A,
        )

    @property
    def noise_of_A(self) -> CarrierNoise | None:
        """The noise of A that was found, or stated as standard deviations; None where A counts as exact."""
        found = None if self.noise.model is None else self.noise.model.carrier_noise
        stated = self.options.carrier_noise
        return found or (stated if stated is not None and stated.covariances is None else None)
