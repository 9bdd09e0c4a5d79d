"""The result of every simulator: a problem, its truth, and the errors of an answer against the truth."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Protocol

import gtsam
import numpy as np
from rwhec_factors.se3 import so3_logmap

from gtsam_rwhec.errors import FrameError, ScaleError
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.problem.problem import Problem


class PosesAndScale(Protocol):
    """An answer with poses by name and a scale, such as a ``gtsam_rwhec.Solution``."""

    @property
    def X(self) -> Mapping[str, gtsam.Pose3]:
        """T_targetcarrier_target of each target."""

    @property
    def Y(self) -> Mapping[str, gtsam.Pose3]:
        """T_sensorcarrier_sensor of each sensor."""

    @property
    def scale(self) -> float | Mapping[str, float]:
        """One alpha for all targets, or one for each target; t_B = alpha * (true length)."""


@dataclass(frozen=True, slots=True)
class FrameDistance:
    """Distance of one estimated frame from its truth."""

    translation_m: float  #: |t_estimated - t_true|, metres
    rotation_rad: float  #: Angle of R_true' R_estimated (the geodesic distance on SO(3)), radians, in [0, pi]

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
    """Distance of an answer from the truth of its simulation."""

    #: X, Y: error of each target's frame (X) and of each sensor's frame (Y), by name
    X: dict[str, FrameDistance]
    Y: dict[str, FrameDistance]
    #: |alpha_estimated - alpha_true| / alpha_true, by target in scale mode ``"per_target"``
    relative_scale: float | dict[str, float]


@dataclass(frozen=True, slots=True)
class Simulation:
    """A simulated calibration problem and its truth."""

    problem: Problem  #: The measurements, ready for ``gtsam_rwhec.solve``.
    X: dict[str, Array]  #: dict of str to (4, 4): True T_targetcarrier_target by target, metres; read-only
    Y: dict[str, Array]  #: dict of str to (4, 4): True T_sensorcarrier_sensor by sensor, metres; read-only
    #: True alpha, t_B = alpha * (true length), by target in scale mode ``"per_target"``
    scale: float | dict[str, float]

    def __post_init__(self) -> None:
        for frames in (self.X, self.Y):
            for pose in frames.values():
                pose.setflags(write=False)

    def errors(self, answer: PosesAndScale) -> CalibrationErrors:
        """Errors of an answer to ``problem``, from this library or any other method.

        Raises
        ------
        FrameError
            If the answer lacks one of the simulation's frames or one of its scales.
        ScaleError
            If the answer has one scale and the problem has a scale for each target, or the other way round.
        """
        return CalibrationErrors(
            X=_frame_distances(answer.X, self.X, "X"),
            Y=_frame_distances(answer.Y, self.Y, "Y"),
            relative_scale=_scale_errors(answer.scale, self.scale),
        )


def frame_distance(estimate: Array, truth: Array) -> FrameDistance:
    """Distance between two (4, 4) poses of one frame."""
    turn = so3_logmap((truth[:3, :3].T @ estimate[:3, :3])[None])
    return FrameDistance(float(np.linalg.norm(estimate[:3, 3] - truth[:3, 3])), float(np.linalg.norm(turn)))


def _require(names: Iterable[str], present: Mapping[str, object], what: str) -> None:
    missing = [name for name in names if name not in present]
    if missing:
        raise FrameError(
            f"Simulation.errors: the answer's {what} has no {', '.join(missing)} (it has: "
            f"{', '.join(present) or 'none'}); pass an answer to this simulation's problem"
        )


def _frame_distances(
    estimates: Mapping[str, gtsam.Pose3], truth: Mapping[str, Array], what: str
) -> dict[str, FrameDistance]:
    _require(truth, estimates, what)
    return {name: frame_distance(estimates[name].matrix(), truth[name]) for name in truth}


def _scale_errors(
    estimate: float | Mapping[str, float], truth: float | Mapping[str, float]
) -> float | dict[str, float]:
    if isinstance(truth, Mapping) and isinstance(estimate, Mapping):
        _require(truth, estimate, "scale")
        return {name: abs(estimate[name] - alpha) / alpha for name, alpha in truth.items()}
    if isinstance(truth, Mapping) or isinstance(estimate, Mapping):
        needs = "a scale for each target; pass a mapping" if isinstance(truth, Mapping) else "one scale; pass a number"
        raise ScaleError(f"Simulation.errors: the answer's scale is {estimate!r}, but this problem has {needs}")
    return abs(estimate - truth) / truth
