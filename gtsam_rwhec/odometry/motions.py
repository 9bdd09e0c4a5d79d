"""Motions of two odometries over windows, as `Problem.add_motion` takes them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gtsam_rwhec.errors import UnderdeterminedError
from gtsam_rwhec.geometry.blas_threads import one_blas_thread
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.odometry.clocks import Clock, first_offset
from gtsam_rwhec.odometry.gates import gated
from gtsam_rwhec.odometry.noise_by_residuals import first_rotation_variances
from gtsam_rwhec.odometry.options import OdometryOptions
from gtsam_rwhec.odometry.sampling import SampledTrack
from gtsam_rwhec.odometry.tracks import OdometryTrack
from gtsam_rwhec.odometry.window_choice import best_length, edges_near
from gtsam_rwhec.odometry.window_motions import WindowMotions
from gtsam_rwhec.solver.rotations import project

#: Without stated noise the translation's counts as this part of the way, in metres a root of a second.
WAY_SHARE = 0.01
#: Fewer windows than this make no calibration.
FEWEST = 6


@dataclass(frozen=True)
class Motions:
    """Motions of two odometries over the same windows: A Y = Y B with Y = T_a_b.

    Attributes
    ----------
    A, B : (N, 4, 4) arrays
        T_before_after of the first and of the second sensor; lengths as each measured them.
    sigma : (N,) array
        Standard deviation of the translation along each axis, metres: of both tracks together.
    kappa : (N,) array
        Concentration of the rotation: of both tracks together.
    start_ns, end_ns : (N,) integers
        The windows, on the first sensor's clock.
    time_offset_s : float
        The second sensor's stamp t is the first's t + offset.
    """

    A: Array
    B: Array
    sigma: Array
    kappa: Array
    start_ns: np.ndarray
    end_ns: np.ndarray
    time_offset_s: float


@one_blas_thread()
def odometry_motions(track_a: OdometryTrack, track_b: OdometryTrack, options: OdometryOptions | None = None) -> Motions:
    """The motions of two sensors over windows chosen for information, with noise that grows with the window.

    ``problem.add_motion(sensor, motions.A, motions.B, motions.sigma, motions.kappa, stamps_ns=motions.start_ns)`` adds
    them where the first sensor's frame is the carrier. Windows follow one another, so their errors are independent.

    Raises
    ------
    UnderdeterminedError
        The tracks share too few windows.
    """
    options = options or OdometryOptions()
    gates = [gated(track, options) for track in (track_a, track_b)]
    clock = first_offset(gates[0].track, gates[1].track, options) if options.estimate_time_offsets else Clock(0.0)
    origin = int(track_a.stamps_ns[0])
    samples = [
        SampledTrack(gate.track, origin, offset, gate.good)
        for gate, offset in zip(gates, (0.0, clock.offset_s), strict=True)
    ]
    edges = edges_near(samples, options.window_s or best_length(samples, options.max_gap_s))
    windows = WindowMotions.of(samples, edges, options.max_gap_s, clocks=False)
    if len(windows) < FEWEST:
        raise UnderdeterminedError(
            f"{track_a.sensor} and {track_b.sensor} share {len(windows)} windows of time; at least {FEWEST} are "
            "needed. Look for gaps, for clocks that are apart, and for steps that are too fast"
        )
    rotation = first_rotation_variances(windows)
    translation = np.empty(2)
    for k, track in enumerate((track_a, track_b)):
        way = np.linalg.norm(windows.M[k, :, :3, 3], axis=1) / windows.length[k]
        translation[k] = (WAY_SHARE * max(float(np.median(way)), 1e-3)) ** 2
        if track.noise is not None:
            rotation[k] = track.noise.rotation_rad_per_sqrt_s**2
            translation[k] = track.noise.translation_m_per_sqrt_s**2
    # The rotation's noise moves what is still to go of the way; about each axis two of three directions count.
    turned = 2.0 / 3.0 * rotation[:, None] * np.einsum("mnii->mn", windows.second)
    of_translation = (translation[:, None] * windows.length + turned).sum(axis=0)
    of_rotation = (rotation[:, None] * windows.length).sum(axis=0)
    stamps = [origin + np.round(times * 1e9).astype(np.int64) for times in (windows.start, windows.end)]
    A, B = windows.M
    for M in (A, B):  # products of many rotations are off by their rounding
        M[:, :3, :3] = project(M[:, :3, :3])
    return Motions(A, B, np.sqrt(of_translation), 1.0 / (2.0 * of_rotation), stamps[0], stamps[1], clock.offset_s)
