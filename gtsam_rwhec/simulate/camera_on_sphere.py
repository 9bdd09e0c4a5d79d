"""Section 8.1 of the RWHEC paper: a hand-mounted camera moves on a sphere about a fixed target.

**Roles.** The paper writes A X = Y B with X = T_hand_camera, Y = T_base_target, A = T_base_hand and puts the noise on
B = T_target_camera. In this library's terms the noise sits on what is called T_sensor_target, so to reproduce the
paper the *camera* is entered as ``target`` ("camera", carried by the hand, errors t_x and r_x of Tables 2 and 3) and
the target's mounting as ``sensor`` ("marker", carried by the base, errors t_y and r_y). For a simulation with the noise
on what a camera really measures use :func:`gtsam_rwhec.simulate.general`.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.random import Generator

from gtsam_rwhec.errors import OptionError
from gtsam_rwhec.problem.problem import Problem
from gtsam_rwhec.simulate.noise import Noise, Seed, perturb, released_sphere_translations, weights_of
from gtsam_rwhec.simulate.scales import SHARED_SCALE
from gtsam_rwhec.simulate.simulation import Simulation
from gtsam_rwhec.simulate.transforms import FloatArray, inverse, pose

CAMERA = "camera"
MARKER = "marker"

KNOT_RANGE_RAD = (math.pi / 4.0, 3.0 * math.pi / 4.0)
SAMPLE_PERIOD_S = 0.5
KNOT_PERIOD_S = 1.0
OUTER_RADIUS_M = 1.0
INNER_RADIUS_M = 0.3

T_HAND_CAMERA = pose(np.eye(3), [0.0, 0.0, 0.1])
T_BASE_MARKER = pose(np.diag([-1.0, -1.0, 1.0]), [0.5, 0.0, 0.0])


def sphere(
    noise: Noise | None,
    seed: Seed,
    *,
    monocular: bool = False,
    spheres: int | None = None,
    number_of_measurements: int = 100,
    keep_measurements: bool = True,
) -> Simulation:
    """Simulate Section 8.1: one camera on a robot's hand, one target fixed to the robot's base.

    Parameters
    ----------
    noise
        Noise on B = T_marker_camera (``released`` reproduces Tables 2 and 3); also gives the measurements' weights,
        sigma and kappa as they are. ``None``: exact measurements, unit weights.
    seed
        Seed, or a generator to draw from (path and noise).
    monocular
        The problem has one unknown scale, and all translations of B are multiplied by alpha = 0.5 *after* the noise,
        as in the paper (weights stay 1/sigma^2, also as in the paper's runs: the noise of the scaled B is half of
        sigma). Default: known scale.
    spheres
        1: all poses at radius 1 m. 2: the first half at radius 1 m and the second at 0.3 m. Default: the paper's, 1
        with known scale and 2 when monocular. A monocular camera on one sphere has no unique calibration.
    number_of_measurements
        Camera poses, half a second apart; 100 in the paper.
    keep_measurements
        Passed to :class:`gtsam_rwhec.Problem`.

    Returns
    -------
    A simulation with one target, "camera", and one sensor, "marker" (see the module for why).

    Raises
    ------
    OptionError
        If spheres is neither 1 nor 2, or there are no measurements.
    """
    count = 2 if monocular else 1
    if spheres is not None:
        count = spheres
    if count not in (1, 2):
        raise OptionError(f"sphere: spheres is {spheres!r}; choose 1 (radius 1 m) or 2 (radii 1 m and 0.3 m)")
    if number_of_measurements < 1:
        raise OptionError(f"sphere: number_of_measurements is {number_of_measurements}; ask for at least one")
    generator = np.random.default_rng(seed)

    radii_m = np.full(number_of_measurements, OUTER_RADIUS_M)
    if count == 2:
        radii_m[(number_of_measurements + 1) // 2 :] = INNER_RADIUS_M
    T_marker_camera = sphere_trajectory(radii_m, generator)
    A = T_BASE_MARKER @ T_marker_camera @ inverse(T_HAND_CAMERA)
    B = perturb(T_marker_camera, noise, generator, released_sphere_translations)
    scale = SHARED_SCALE if monocular else 1.0
    B[:, :3, 3] *= scale

    problem = Problem(scale="shared" if monocular else "known", keep_measurements=keep_measurements)
    problem.add(
        target=CAMERA,
        sensor=MARKER,
        A=A,
        B=B,
        **weights_of(noise),
        source="simulate.sphere",
    )
    return Simulation(problem, X={CAMERA: T_HAND_CAMERA.copy()}, Y={MARKER: T_BASE_MARKER.copy()}, scale=scale)


def sphere_trajectory(radii_m: FloatArray, seed: Seed) -> FloatArray:
    """Camera poses T_marker_camera along a random smooth path over a sphere centred on the marker.

    Azimuth and polar angle are uniform cubic B-splines, one knot a second with values uniform in [pi/4, 3pi/4], sampled
    every half second.

    Parameters
    ----------
    radii_m
        (N,) distance of each pose from the marker, metres.
    seed
        Seed, or a generator to draw from.

    Returns
    -------
    (N, 4, 4) poses; the z axis (optical) points to the marker, y to the sphere's south pole, x = y cross z.
    """
    generator = np.random.default_rng(seed)
    times_s = np.linspace(0.0, SAMPLE_PERIOD_S * (len(radii_m) - 1), len(radii_m))
    azimuth = _spline_angles(times_s, generator)
    polar = _spline_angles(times_s, generator)
    outward = np.stack(
        [np.sin(polar) * np.cos(azimuth), np.sin(polar) * np.sin(azimuth), np.cos(polar)],
        axis=1,
    )
    south = np.stack(
        [np.cos(polar) * np.cos(azimuth), np.cos(polar) * np.sin(azimuth), -np.sin(polar)],
        axis=1,
    )
    z = -outward
    return pose(np.stack([np.cross(south, z), south, z], axis=2), radii_m[:, None] * outward)


def _spline_angles(times_s: FloatArray, generator: Generator) -> FloatArray:
    """Evaluate a random uniform cubic B-spline (radians) at the given times from zero on."""
    segments = np.floor(times_s / KNOT_PERIOD_S).astype(np.int64)
    u: FloatArray = times_s / KNOT_PERIOD_S - segments
    knots = generator.uniform(*KNOT_RANGE_RAD, int(segments[-1]) + 4)
    weights = np.stack([(1.0 - u) ** 3, 3.0 * u**3 - 6.0 * u**2 + 4.0, 1.0 + 3.0 * (u + u**2 - u**3), u**3], axis=1)
    angles: FloatArray = np.sum(weights * knots[segments[:, None] + np.arange(4)], axis=1) / 6.0
    return angles
