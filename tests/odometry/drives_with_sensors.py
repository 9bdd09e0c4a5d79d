"""Small drives with a few sensors, for the tests of this folder."""

from __future__ import annotations

import numpy as np
from rwhec_factors import se3

from gtsam_rwhec import odometry, simulate
from gtsam_rwhec.simulate.drives import Drive, DriveShape


def sensors(seed: int = 0, *, outliers: float = 0.0, clocks: bool = False) -> dict[str, simulate.SimulatedOdometry]:
    """Two LiDARs and two cameras, of which one has no scale; the first LiDAR is level."""
    generator = np.random.default_rng(seed)
    made = {}
    for i, name in enumerate(("lidar", "rear", "stereo", "camera")):
        T = se3.expmap(generator.normal(0.0, 0.8, (1, 6)))[0]
        if i == 0:
            T[:3, :3] = np.eye(3)
        made[name] = simulate.SimulatedOdometry(
            T,
            rotation_rad_per_sqrt_s=0.001 * (1 + i),
            translation_m_per_sqrt_s=0.01 * (1 + i),
            scale=0.4 if name == "camera" else 1.0,
            clock_offset_s=(0.0, 0.12, -0.2, 0.05)[i] if clocks else 0.0,
            outlier_share=outliers,
        )
    return made


def drive(shape: DriveShape, seed: int = 0, *, seconds: float = 40.0, **of_sensors: float) -> Drive:
    """A drive with these sensors."""
    return simulate.drive(sensors(seed, **of_sensors), shape, seconds=seconds, seed=seed)  # type: ignore[arg-type]


def tracks(driven: Drive) -> list[odometry.OdometryTrack]:
    """What `calibrate_odometries` takes."""
    return [
        odometry.OdometryTrack(name, stamps, T, has_unknown_scale=driven.sensors[name].scale != 1.0)
        for name, (stamps, T) in driven.tracks.items()
    ]


def squares(found: odometry.OdometryCalibration, driven: Drive) -> tuple[float, int]:
    """The joint squared Mahalanobis distance of the poses to the truth, along what is finite, and its degrees."""
    off = [
        se3.logmap(se3.inverse(driven.T(found.reference, name)[None]) @ found.T_reference_sensor[name])[0]
        for name in found.order
    ]
    error = np.concatenate(off)
    C = found.covariance[: len(error), : len(error)]
    finite = np.isfinite(np.diagonal(C))
    C, error = C[np.ix_(finite, finite)], error[finite]
    return float(error @ np.linalg.solve(C, error)), int(finite.sum())
