"""What follows from a calibration's poses and covariances alone, as people read it: angles, relative poses, points."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import gtsam
import numpy as np
from pydantic import Field

from gtsam_rwhec.calibration.calibrated import Calibration
from gtsam_rwhec.evidence.record import EvidenceRecord
from gtsam_rwhec.files.natural_order import natural_key

Triple = tuple[float, float, float]


class FrameAngles(EvidenceRecord):
    """The rotation of a frame on its carrier as angles."""

    frame: str = Field(description="sensor or target")
    rpy_deg: Triple = Field(description="roll, pitch, yaw, degrees: R = Rz(yaw) Ry(pitch) Rx(roll)")


class Derived(EvidenceRecord):
    """What follows from poses and covariances."""

    angles: tuple[FrameAngles, ...] = Field(description="of every sensor and target")


def derived_of(calibration: Calibration) -> Derived:
    """What follows from a calibration's poses and covariances."""
    return Derived(angles=tuple(_angles(calibration.Y | calibration.X)))


def _angles(poses: Mapping[str, gtsam.Pose3]) -> Iterator[FrameAngles]:
    for name in sorted(poses, key=natural_key):
        yield FrameAngles(frame=name, rpy_deg=_triple(np.degrees(poses[name].rotation().rpy())))


def _triple(values: np.ndarray) -> Triple:
    x, y, z = (float(value) + 0.0 for value in values)
    return x, y, z
