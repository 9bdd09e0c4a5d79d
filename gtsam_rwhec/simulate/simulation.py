"""What every simulator returns: a problem, the truth behind it, and how far an answer is from that truth."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Protocol

import gtsam
import numpy as np
from numpy.typing import NDArray

from gtsam_rwhec.errors import FrameError, ScaleError
from gtsam_rwhec.problem.problem import Problem

FloatArray = NDArray[np.float64]


class PosesAndScale(Protocol):
    """Anything with poses by name and a scale; ``gtsam_rwhec.Solution`` is one."""

    @property
    def X(self) -> Mapping[str, gtsam.Pose3]:
        """T_targetcarrier_target by target."""

    @property
    def Y(self) -> Mapping[str, gtsam.Pose3]:
        """T_sensorcarrier_sensor by sensor."""

    @property
    def scale(self) -> float | Mapping[str, float]:
        """One alpha, or one by target; t_B = alpha * (true length)."""


@dataclass(frozen=True, slots=True)
class FrameDistance:
    """Distance of one estimated frame from its truth.

    Attributes
    ----------
    translation_m
        |t_estimated - t_true|, metres.
    rotation_rad
        Angle of R_true' R_estimated (the geodesic distance on SO(3)), radians, in [0, pi].
    """

    translation_m: float
    rotation_rad: float

    @property
    def translation_mm(self) -> float:
        """The translation error in millimetres, the unit of the paper's tables."""
        return 1e3 * self.translation_m

    @property
    def rotation_deg(self) -> float:
        """The rotation error in degrees, the unit of the paper's tables."""
        return math.degrees(self.rotation_rad)


@dataclass(frozen=True, slots=True)
class CalibrationErrors:
    """Distance of an answer from the truth of its simulation.

    Attributes
    ----------
    X, Y
        Error of each target's and of each sensor's frame, by name.
    relative_scale
        |alpha_estimated - alpha_true| / alpha_true; one number, or one by target (scale mode ``"per_target"``).
    """

    X: dict[str, FrameDistance]
    Y: dict[str, FrameDistance]
    relative_scale: float | dict[str, float]


@dataclass(frozen=True, slots=True)
class Simulation:
    """A simulated calibration problem and the truth behind it.

    Attributes
    ----------
    problem
        The measurements, ready for ``gtsam_rwhec.solve``.
    X
        True T_targetcarrier_target by target, (4, 4), metres; read-only arrays.
    Y
        True T_sensorcarrier_sensor by sensor, (4, 4), metres; read-only arrays.
    scale
        True alpha, t_B = alpha * (true length): one number, or one by target (scale mode ``"per_target"``).
    """

    problem: Problem
    X: dict[str, FloatArray]
    Y: dict[str, FloatArray]
    scale: float | dict[str, float]

    def __post_init__(self) -> None:
        for frames in (self.X, self.Y):
            for pose in frames.values():
                pose.setflags(write=False)

    def errors(self, answer: PosesAndScale) -> CalibrationErrors:
        """Compare an answer with the truth.

        Parameters
        ----------
        answer
            A solution of ``problem``, by this library or any other method.

        Raises
        ------
        FrameError
            If the answer lacks one of the simulation's frames or one of its scales.
        ScaleError
            If the answer has one scale for all where the problem has one for each target, or the other way round.
        """
        return CalibrationErrors(
            X=_frame_distances(answer.X, self.X, "X"),
            Y=_frame_distances(answer.Y, self.Y, "Y"),
            relative_scale=_scale_errors(answer.scale, self.scale),
        )


def frame_distance(estimate: FloatArray, truth: FloatArray) -> FrameDistance:
    """Distance between two (4, 4) poses of one frame."""
    R_true_estimate = truth[:3, :3].T @ estimate[:3, :3]
    # |R - R'|/2 and (tr R - 1)/2 are the angle's sine and cosine: with both, small angles keep all their digits.
    skew = R_true_estimate - R_true_estimate.T
    sine = math.sqrt(skew[0, 1] ** 2 + skew[0, 2] ** 2 + skew[1, 2] ** 2) / 2.0
    cosine = (float(np.trace(R_true_estimate)) - 1.0) / 2.0
    return FrameDistance(
        translation_m=float(np.linalg.norm(estimate[:3, 3] - truth[:3, 3])),
        rotation_rad=math.atan2(sine, cosine),
    )


def _require(names: Iterable[str], present: Mapping[str, object], what: str) -> None:
    missing = [name for name in names if name not in present]
    if missing:
        raise FrameError(
            f"Simulation.errors: the answer's {what} has no {', '.join(missing)} (it has: "
            f"{', '.join(present) or 'none'}); pass an answer to this simulation's problem"
        )


def _frame_distances(
    estimates: Mapping[str, gtsam.Pose3], truth: Mapping[str, FloatArray], what: str
) -> dict[str, FrameDistance]:
    _require(truth, estimates, what)
    return {name: frame_distance(estimates[name].matrix(), truth[name]) for name in truth}


def _scale_errors(
    estimate: float | Mapping[str, float], truth: float | Mapping[str, float]
) -> float | dict[str, float]:
    if isinstance(truth, Mapping):
        if not isinstance(estimate, Mapping):
            raise ScaleError(
                f"Simulation.errors: the answer's scale is {estimate!r}, but this problem has one for each target; "
                "pass a mapping from target to scale"
            )
        _require(truth, estimate, "scale")
        return {name: abs(estimate[name] - alpha) / alpha for name, alpha in truth.items()}
    if isinstance(estimate, Mapping):
        raise ScaleError(
            f"Simulation.errors: the answer's scale has entries for {', '.join(estimate)}, but this problem has one "
            "scale; pass a number"
        )
    return abs(estimate - truth) / truth
