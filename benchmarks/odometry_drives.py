"""Simulated drives with six odometries, their Cramer-Rao bound, and one calibration against both."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from rwhec_factors import se3

from gtsam_rwhec import odometry, simulate
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.odometry.prior_knowledge import GivenRows
from gtsam_rwhec.odometry.window_likelihood import SCALE, Layout, State, eliminated, linearised, weights
from gtsam_rwhec.odometry.window_motions import SampledTrack, WindowMotions
from gtsam_rwhec.simulate.drives import Drive, DriveShape

#: Three LiDARs and three cameras: degrees and metres that a second of driving adds (about each and along each axis).
LIDAR = (np.radians(0.11), 0.02)
CAMERA = (np.radians(0.17), 0.03)
#: A height is measured to this, metres.
HEIGHT_M = 0.02
#: The reference is this high above the ground, metres.
REFERENCE_M = 1.8
RATE_HZ = 10.0


def vehicle(generator: np.random.Generator, *, outliers: float, clocks: bool) -> dict[str, simulate.SimulatedOdometry]:
    """Six sensors in random places; the first is level, and the cameras' scales are unknown."""
    sensors = {}
    for i in range(6):
        T = se3.expmap(np.r_[generator.normal(0.0, 1.0, 3), generator.normal(0.0, 1.0, 3)][None])[0]
        is_lidar = i < 3
        if i == 0:
            T[:3, :3] = np.eye(3)
        rotation, translation = LIDAR if is_lidar else CAMERA
        sensors[f"lidar {i}" if is_lidar else f"camera {i}"] = simulate.SimulatedOdometry(
            T,
            rotation,
            translation,
            scale=1.0 if is_lidar else float(generator.uniform(0.3, 2.0)),
            clock_offset_s=float(generator.uniform(-0.3, 0.3)) if clocks and i else 0.0,
            outlier_share=outliers,
        )
    return sensors


def drive(shape: DriveShape, seconds: float, seed: int, *, outliers: float = 0.0, clocks: bool = True) -> Drive:
    """One drive of such a vehicle."""
    generator = np.random.default_rng(seed)
    sensors = vehicle(generator, outliers=outliers, clocks=clocks)
    return simulate.drive(sensors, shape, seconds=seconds, rate_hz=RATE_HZ, seed=generator)


def tracks_of(driven: Drive) -> list[odometry.OdometryTrack]:
    """What is calibrated: the cameras' scales are unknown, and no noise is stated."""
    return [
        odometry.OdometryTrack(name, stamps, T, has_unknown_scale=driven.sensors[name].scale != 1.0)
        for name, (stamps, T) in driven.tracks.items()
    ]


def heights_of(driven: Drive, seed: int) -> odometry.Given:
    """A height for each sensor, measured with noise."""
    generator = np.random.default_rng(10_000 + seed)
    first = next(iter(driven.sensors.values())).T_vehicle_sensor[2, 3]
    return odometry.Given(
        heights_m={
            name: (
                REFERENCE_M + float(sensor.T_vehicle_sensor[2, 3] - first) + generator.normal(0.0, HEIGHT_M),
                HEIGHT_M,
            )
            for name, sensor in driven.sensors.items()
        }
    )


def cramer_rao(driven: Drive, given: odometry.Given, *, clocks: bool) -> Array:
    """The bound (d, d) on the covariance of [pose of each but the first, log scales], from all steps as simulated.

    Each step of each sensor is one measurement, at the true motion, which is a nuisance, as are clocks and the ground.
    """
    names = list(driven.sensors)
    sensors = list(driven.sensors.values())
    first = sensors[0].T_vehicle_sensor
    at = driven.T_world_vehicle @ first
    motion = se3.inverse(at[:-1]) @ at[1:]
    scaled = np.array([sensor.scale != 1.0 for sensor in sensors])
    state = State(
        np.array([driven.T(names[0], name) for name in names]),
        np.array([sensor.scale for sensor in sensors]),
        np.zeros(len(names)),
        motion,
        np.zeros(2),
        REFERENCE_M,
    )
    true_tracks = [
        odometry.OdometryTrack(name, driven.stamps_ns, _scaled(driven.T_world_vehicle @ s.T_vehicle_sensor, s.scale))
        for name, s in driven.sensors.items()
    ]
    good = np.ones(len(motion), dtype=bool)
    samples = [SampledTrack(track, 0, 0.0, good) for track in true_tracks]
    windows = WindowMotions.of(samples, driven.stamps_ns * 1e-9, 10.0)
    rows = GivenRows(given, {name: k for k, name in enumerate(names)}, np.array([0.0, 0.0, 1.0]), 1e-6, 10.0)
    layout = Layout.of(scaled, clocks=clocks, has_ground=rows.has_ground)
    W = weights(
        windows,
        np.array([s.rotation_rad_per_sqrt_s**2 for s in sensors]),
        np.array([(s.translation_m_per_sqrt_s * s.scale) ** 2 for s in sensors]),
    )
    information = eliminated(linearised(windows, state), W, layout).H + rows.rows(state, layout).information
    kept = np.r_[layout.poses.ravel(), layout.at[layout.open[:, SCALE], SCALE]]
    return np.linalg.inv(information)[np.ix_(kept, kept)]


def _scaled(T: Array, scale: float) -> Array:
    T = T.copy()
    T[:, :3, 3] *= scale
    return T


@dataclass(frozen=True)
class Run:
    """One drive: errors [pose tangents, log scales] (d,), the bound (d, d), and the calibration."""

    error: Array
    bound: Array
    found: odometry.OdometryCalibration


def run(
    shape: DriveShape, seconds: float, seed: int, *, heights: bool = False, outliers: float = 0.0, clocks: bool = True
) -> Run:
    """Simulate, calibrate, and compare with the truth."""
    driven = drive(shape, seconds, seed, outliers=outliers, clocks=clocks)
    given = heights_of(driven, seed) if heights else odometry.Given()
    tracks = tracks_of(driven)
    options = odometry.OdometryOptions(estimate_time_offsets=clocks)
    found = odometry.calibrate_odometries(tracks, reference=tracks[0].sensor, given=given, options=options)
    off = [
        se3.logmap(se3.inverse(driven.T(found.reference, name)[None]) @ found.T_reference_sensor[name])[0]
        for name in found.order
    ]
    scales = [np.log(scale / driven.sensors[name].scale) for name, scale in found.scales.items()]
    bound = cramer_rao(driven, given, clocks=clocks) if shape == "3d" or heights else np.zeros((0, 0))
    return Run(np.r_[np.concatenate(off), scales], bound, found)
