"""The calibration that ``calibrate`` returns: the poses to use, the verdict, and everything that was found."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field

import gtsam
import numpy as np
from numpy.typing import ArrayLike
from scipy.special import chdtri

from gtsam_rwhec.calibration.choices import Choice
from gtsam_rwhec.calibration.misreadings import Misreading
from gtsam_rwhec.calibration.options import CalibrateOptions
from gtsam_rwhec.calibration.plausibility import Implausible
from gtsam_rwhec.calibration.sizes import TargetSize
from gtsam_rwhec.calibration.task_units import (
    CARRIER_WORDS,
    PointUncertainty,
    checked_level,
    checked_point,
    ellipsoid,
    jacobian_of_point,
)
from gtsam_rwhec.calibration.verdict import Finding, Judgement, Verdict
from gtsam_rwhec.calibration.views import SensorView
from gtsam_rwhec.errors import FrameError, PoseError, UnderdeterminedError
from gtsam_rwhec.files.terminal_text import brief
from gtsam_rwhec.geometry.pose_covariances import relative_jacobian
from gtsam_rwhec.geometry.poses import Array, PoseLike
from gtsam_rwhec.noise_model.found import NoiseInData
from gtsam_rwhec.problem.pairs import Pair
from gtsam_rwhec.refinement.refined import Refined
from gtsam_rwhec.refinement.unknowns import Unknown
from gtsam_rwhec.solving.solution import Solution

#: A sentence about outliers names at most this many pairs.
NAMED = 5


@dataclass(frozen=True)
class NoiseFound:
    """The noise that a calibration counts with, one standard deviation an axis; ``str()`` is a sentence.

    Attributes
    ----------
    source : str
        Where it comes from: "estimated from the residuals", "as given".
    rotation_rad, translation_m : dict of (target, sensor) to float
        Of B, by pair: of the pair's median measurement, root mean square over axes.
    carriers : str
        The noise of A, in words.
    model : NoiseInData or None
        All that the data say of their noise, of A's, in time and over the configuration; None where B's alone was
        estimated, or noise was given.
    simple : str
        Why B's alone was estimated; empty with a model.
    has_failed : bool
        Whether the model of all noise could not be computed, or the noise that was stated for A not used.
    """

    source: str
    rotation_rad: dict[Pair, float]
    translation_m: dict[Pair, float]
    carriers: str
    model: NoiseInData | None = None
    simple: str = ""
    has_failed: bool = False

    def __str__(self) -> str:
        if self.model is not None:
            return str(self.model)
        if not self.rotation_rad:
            return f"Noise of B: {self.source}. Noise of A: {self.carriers}."
        degrees = [math.degrees(value) for value in self.rotation_rad.values()]
        millimetres = [1e3 * value for value in self.translation_m.values()]
        return (
            f"Noise of B: {_span(degrees)}° and {_span(millimetres)} mm for each axis of a typical measurement, "
            f"{self.source}. Noise of A: "
            f"{self.carriers}."
        )


def _span(values: list[float]) -> str:
    low, high = f"{min(values):.2g}", f"{max(values):.2g}"
    return low if low == high else f"{low} to {high}"


@dataclass(frozen=True)
class Outliers:
    """The measurements that were left out because they contradict the others.

    Attributes
    ----------
    inliers : dict of (target, sensor) to (N,) booleans
        The measurements that were kept, in the order of ``problem.measurements``; empty if none were looked for.
    counts : dict of (target, sensor) to (int, int)
        The number kept, and the number of all.
    left_out : tuple of str
        Sensors and targets that have no measurement left, and so no pose.
    looked_for : bool
        Whether outliers were looked for.
    """

    inliers: dict[Pair, np.ndarray]
    counts: dict[Pair, tuple[int, int]]
    left_out: tuple[str, ...]
    looked_for: bool

    @property
    def number(self) -> int:
        """How many measurements were left out."""
        return sum(total - kept for kept, total in self.counts.values())

    def __str__(self) -> str:
        total = sum(number for _, number in self.counts.values())
        if not self.looked_for:
            return f"Outliers were not looked for among {total} measurements."
        out = {pair: (number - kept, number) for pair, (kept, number) in self.counts.items() if kept < number}
        if not out:
            return f"No outliers among {total} measurements."
        most = sorted(out.items(), key=lambda item: -item[1][0])[:NAMED]
        named = [f"{number} of {of} of {pair}" for pair, (number, of) in most]
        more = f", and some of {len(out) - NAMED} other pairs" if len(out) > NAMED else ""
        said = f"{self.number} of {total} measurements contradict the others and were left out"
        return f"{said}: {', '.join(named)}{more}."


@dataclass(frozen=True)
class Carriers:
    """The names of the carriers as the problem states them; None where it does not."""

    sensors: str | None = None
    targets: str | None = None


@dataclass(frozen=True)
class Calibration:
    """The result of ``calibrate``.

    Attributes
    ----------
    X, Y : dict of str to gtsam.Pose3
        The poses to use: T_targetcarrier_target and T_sensorcarrier_sensor, metres. They are the refined ones if there
        are any, else the certified ones.
    scale : float or dict of str to float
        Measured length / true length.
    time_offsets_s : dict of str to float
        By sensor, if estimated: the sensor's stamp t is the carriers' t + offset.
    judgement : Judgement
        The verdict with its grounds; ``str()`` is one sentence.
    solution : Solution or None
        The certified solution of the measurements that were kept. None where there is no answer with a positive scale;
        then there are no poses either.
    refined : Refined or None
        The refined calibration: graph, values, joint covariance. None if it could not be made, or was not because the
        measurements were misread; ``choices`` say why.
    noise : NoiseFound
        The noise that was found.
    outliers : Outliers
        The measurements that were left out.
    misreadings : tuple of Misreading
        Likely mistakes in the reading of A and B, each with its cure; two or more fit alike.
    implausible : Implausible or None
        Residuals that no sensor has.
    sizes : tuple of TargetSize
        What the motion says about sizes that were said to be known.
    cannot_tell : tuple of str
        Mistakes in the reading of A and B that would change no residual: no data can show them.
    findings : tuple of Finding
        What was found against the poses besides what certificate and free directions say.
    choices : tuple of Choice
        Every choice, with its evidence.
    notes : tuple of str
        Warnings on the way that change no choice.
    views : dict of str to SensorView
        Where each sensor saw its targets.
    carriers : Carriers
    options : CalibrateOptions
    """

    X: dict[str, gtsam.Pose3]
    Y: dict[str, gtsam.Pose3]
    scale: float | dict[str, float]
    time_offsets_s: dict[str, float]
    judgement: Judgement
    solution: Solution | None
    refined: Refined | None
    noise: NoiseFound
    outliers: Outliers
    misreadings: tuple[Misreading, ...]
    implausible: Implausible | None
    sizes: tuple[TargetSize, ...]
    cannot_tell: tuple[str, ...]
    findings: tuple[Finding, ...]
    choices: tuple[Choice, ...]
    notes: tuple[str, ...]
    views: dict[str, SensorView] = field(repr=False)
    carriers: Carriers
    options: CalibrateOptions = field(repr=False)

    @property
    def verdict(self) -> Verdict:
        """What to do with the poses."""
        return self.judgement.verdict

    @property
    def verdict_reason(self) -> str:
        """Why, and what to do about it."""
        return self.judgement.reason

    def __str__(self) -> str:
        lines = [str(self.judgement), *map(str, self.points.values()), *map(str, self.choices)]
        return "\n".join(lines)

    # -- covariances --------------------------------------------------------------------------------------------

    def covariance(self, *names: str | Unknown) -> Array:
        """As ``Refined.covariance``; an UnderdeterminedError where there is no refined calibration."""
        return self._known().covariance(*names)

    def standard_deviations(self, name: str) -> tuple[Array, Array]:
        """As ``Refined.standard_deviations``: (3,) degrees and (3,) millimetres, about and along the frame's axes."""
        return self._known().standard_deviations(name)

    def relative(self, first: str, second: str) -> tuple[gtsam.Pose3, Array]:
        """As ``Refined.relative``: T_first_second, and the covariance (6, 6) of its right perturbation."""
        return self._known().relative(first, second)

    def squared_radius(self, dimension: int = 6, confidence: float = 0.95) -> float:
        """As ``Refined.squared_radius``."""
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
            name: self.uncertainty_at(view.point_m, name, level=self.options.level)
            for name, view in self.views.items()
            if name in self.Y
        }

    def uncertainty_at(
        self, point: ArrayLike, frame: str, seen_from: str | None = None, level: float = 0.95
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
            same carrier. The carrier has the name that the problem states. Where it states none, "sensorcarrier",
            "hand", "base" and "rig" mean the carrier of the sensors, and "targetcarrier", "base", "hand" and "world"
            the carrier of the targets: always the one that carries ``frame``.
        level : float
            Probability of the ellipsoid and of the ball.

        Raises
        ------
        FrameError
            There is no such frame, or the two are not on one carrier; the message lists what there is.
        PoseError
            The point is not three numbers, or it is behind a sensor that saw every target in front of it.
        UnderdeterminedError
            There is no refined calibration, and so no covariance.
        """
        refined = self._known()
        p, level = checked_point(point), checked_level(level)
        side, poses = self._side_of(frame)
        if frame in self.views and self.views[frame].in_front and p[2] <= 0.0:
            raise PoseError(
                f"the point {p.tolist()} is behind {frame}, which saw every target in front of it (z > 0); give a "
                "point in the sensor's own frame, z forward, metres"
            )
        seen_from, other = self._resolved(frame, side, poses, seen_from)
        T = poses[frame] if other is None else poses[other].between(poses[frame])
        R = T.rotation().matrix()
        J = jacobian_of_point(R, p)
        jacobians: dict[str | Unknown, Array] = {}
        if other is None:
            jacobians[frame] = J
        else:
            by_poses = J @ relative_jacobian(poses[other], poses[frame])
            jacobians |= {other: by_poses[:, :6], frame: by_poses[:, 6:]}
        if "scale" in refined.names and side == "sensor":
            jacobians["scale"] = -(R @ p)[:, None] / float(np.asarray(refined.scale))
        covariance = refined.covariance_of(jacobians)
        axes, half_lengths, radius = ellipsoid(covariance, level, refined.degrees_of_freedom)
        return PointUncertainty(
            point_m=p,
            frame=frame,
            seen_from=seen_from,
            level=level,
            centre_m=np.asarray(T.transformFrom(p)),
            covariance_m2=covariance,
            axes=axes,
            half_lengths_mm=1e3 * half_lengths,
            radius_mm=1e3 * radius,
            measurement_mm=self._measurement_mm(frame, level) if side == "sensor" else None,
        )

    def _measurement_mm(self, sensor: str, level: float) -> float | None:
        """The radius of a new measurement's noise; the median of the sensor's pairs."""
        noise = [
            value for pair, value in self.noise.translation_m.items() if pair.sensor == sensor and not pair.is_motion
        ]
        return 1e3 * math.sqrt(chdtri(3, 1.0 - level)) * float(np.median(noise)) if noise else None

    def _side_of(self, frame: str) -> tuple[str, Mapping[str, gtsam.Pose3]]:
        for side, poses in (("sensor", self.Y), ("target", self.X)):
            if frame in poses:
                return side, poses
        raise FrameError(
            f"there is no frame {brief(frame)}; there are the sensors {', '.join(self.Y) or '(none)'} and the targets "
            f"{', '.join(self.X) or '(none)'}"
        )

    def _resolved(
        self, frame: str, side: str, poses: Mapping[str, gtsam.Pose3], seen_from: str | None
    ) -> tuple[str, str | None]:
        """The name of the frame in which the point is expressed, and the frame itself; None for the carrier."""
        name = self.carriers.sensors if side == "sensor" else self.carriers.targets
        words = CARRIER_WORDS[side] if name is None else (name, CARRIER_WORDS[side][0])
        if seen_from is None or seen_from in words:
            return name or f"the frame that carries {frame}", None
        if seen_from in poses and seen_from != frame:
            return seen_from, seen_from
        others = [other for other in poses if other != frame]
        raise FrameError(
            f"{brief(seen_from)} is no frame in which a point of {frame} can be expressed; there are the carrier "
            f"({', '.join(words)}){' and ' + ', '.join(others) if others else ''}"
        )


#: The choice that says why there is no refined calibration.
REFINEMENT = "covariances"
