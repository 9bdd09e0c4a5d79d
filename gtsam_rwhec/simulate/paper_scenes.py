"""Section 8.1 of the RWHEC paper: a hand-mounted camera moves on a sphere about a fixed target.

**Roles.** The paper writes A X = Y B with X = T_hand_camera, Y = T_base_target, A = T_base_hand, and puts the noise on
B = T_target_camera. This library puts the noise on T_sensor_target. So, to reproduce the paper, the *camera* is entered
as ``target`` ("camera", carried by the hand, errors t_x and r_x of Tables 2 and 3), and the target's mounting as
``sensor`` ("marker", carried by the base, errors t_y and r_y). :func:`gtsam_rwhec.simulate.general` puts the noise on
the camera's own measurement.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.random import Generator
from rwhec_factors.se3 import inverse, pose

from gtsam_rwhec.errors import OptionError
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.problem.problem import Problem
from gtsam_rwhec.simulate.simulated_noise import Noise, Seed, perturb, rotations_of_vectors, weights_of
from gtsam_rwhec.simulate.simulated_rigs import SHARED_SCALE
from gtsam_rwhec.simulate.simulation import Simulation

CAMERA = "camera"
MARKER = "marker"

#: Both angles' knots are in this range, rad, as in the paper.
KNOT_RANGE_RAD = (math.pi / 4.0, 3.0 * math.pi / 4.0)
#: Two poses are this far apart in time, s, as in the paper.
SAMPLE_PERIOD_S = 0.5
#: Two knots are this far apart in time, s, as in the paper.
KNOT_PERIOD_S = 1.0
#: The camera is at this distance from the marker, m, as in the paper.
OUTER_RADIUS_M = 1.0
#: It is at this distance in the second half of a monocular path, m, as in the paper.
INNER_RADIUS_M = 0.3

#: The true calibration, as in the paper.
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
    noise : Noise or None
        Noise on B = T_marker_camera, whose sigma and kappa are also the weights. ``released`` noise reproduces Tables 2
        and 3. ``None``: exact measurements, unit weights.
    seed : int or numpy.random.Generator
    monocular : bool
        The problem has one unknown scale. As in the paper, all translations of B are multiplied by alpha = 0.5 *after*
        the noise, and the weights stay 1/sigma^2: the noise of the scaled B is half of sigma.
    spheres : int, optional
        1: all poses at radius 1 m. 2: the first half at radius 1 m and the second half at 0.3 m. Default, as in the
        paper: 1 with known scale, 2 when monocular. A monocular camera on one sphere has no unique calibration.
    number_of_measurements : int
        Camera poses, half a second apart; 100 in the paper.

    Raises
    ------
    OptionError
        If spheres is neither 1 nor 2, or there are no measurements.
    """
    count = spheres if spheres is not None else 1 + monocular
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
    B = perturb(T_marker_camera, noise, generator, "8.1")
    scale = SHARED_SCALE if monocular else 1.0
    B[:, :3, 3] *= scale

    problem = Problem(scale="shared" if monocular else "known", keep_measurements=keep_measurements)
    problem.add(CAMERA, MARKER, A, B, **weights_of(noise), source="simulate.sphere")
    return Simulation(problem, X={CAMERA: T_HAND_CAMERA.copy()}, Y={MARKER: T_BASE_MARKER.copy()}, scale=scale)


def sphere_trajectory(radii_m: Array, seed: Seed) -> Array:
    """Camera poses T_marker_camera (N, 4, 4) along a random smooth path, at distances ``radii_m`` (N,) from the marker.

    Azimuth and polar angle are uniform cubic B-splines, with one knot a second, uniform in [pi/4, 3pi/4], sampled every
    half second. The z axis (optical) points to the marker, y to the sphere's south pole, x = y cross z.
    """
    generator = np.random.default_rng(seed)
    times_s = np.linspace(0.0, SAMPLE_PERIOD_S * (len(radii_m) - 1), len(radii_m))
    azimuth = _spline_angles(times_s, generator)
    polar = _spline_angles(times_s, generator)
    outward = np.stack([np.sin(polar) * np.cos(azimuth), np.sin(polar) * np.sin(azimuth), np.cos(polar)], axis=1)
    south = np.stack([np.cos(polar) * np.cos(azimuth), np.cos(polar) * np.sin(azimuth), -np.sin(polar)], axis=1)
    z = -outward
    return pose(np.stack([np.cross(south, z), south, z], axis=2), radii_m[:, None] * outward)


def _spline_angles(times_s: Array, generator: Generator) -> Array:
    """Angles (N,), rad, of a random uniform cubic B-spline at times (N,) that start at zero."""
    segments = np.floor(times_s / KNOT_PERIOD_S).astype(np.int64)
    u: Array = times_s / KNOT_PERIOD_S - segments
    knots = generator.uniform(*KNOT_RANGE_RAD, int(segments[-1]) + 4)
    weights = np.stack([(1.0 - u) ** 3, 3.0 * u**3 - 6.0 * u**2 + 4.0, 1.0 + 3.0 * (u + u**2 - u**3), u**3], axis=1)
    angles: Array = np.sum(weights * knots[segments[:, None] + np.arange(4)], axis=1) / 6.0
    return angles


CAMERAS = ("camera0", "camera1", "camera2", "camera3")
TARGET_ON_HAND = "marker"

#: The marker's grid has these coordinates along each axis of frame i, metres.
GRID_M = (-0.6, 0.0, 0.6)
#: The cameras have these positions in frame i, metres.
CAMERA_POSITIONS_IN_I_M = ((-1.0, 0.0, 0.5), (0.0, 0.0, 1.0), (-1.0, 1.0, 1.0), (-1.0, -1.0, 1.0))
#: The marker's z axis points to one of these points in frame i, metres. They lie on one line.
LOOK_AT_IN_I_M = ((-10.0, -10.0, 0.0), (-7.0, -10.0 / 3.0, 2.0 / 3.0), (-4.0, 10.0 / 3.0, 4.0 / 3.0), (-1.0, 10.0, 2.0))

#: Frame i in the base frame.
T_BASE_I = pose(np.diag([-1.0, -1.0, 1.0]), [0.5, 0.0, 0.0])
#: The true mounting of the target.
T_HAND_MARKER = pose(np.eye(3), [0.0, 0.0, 0.1])


def cameras(noise: Noise | None, seed: Seed, *, monocular: bool = False, keep_measurements: bool = True) -> Simulation:
    """Simulate Section 8.2: four fixed cameras see the hand-mounted target in each of its 108 poses.

    `noise` is on B = T_marker_camera; ``released`` noise reproduces Tables 4 and 5. With `monocular` the problem has
    one unknown scale. Both as in :func:`sphere`. The simulation has four targets, "camera0" ... "camera3", and one
    sensor, "marker" (the module says why).
    """
    generator = np.random.default_rng(seed)
    T_base_camera = fixed_camera_poses()
    T_base_marker = hand_trajectory()
    A = T_HAND_MARKER @ inverse(T_base_marker)
    scale = SHARED_SCALE if monocular else 1.0

    problem = Problem(scale="shared" if monocular else "known", keep_measurements=keep_measurements)
    for name, T_base_camera_j in zip(CAMERAS, T_base_camera, strict=True):
        B = perturb(inverse(T_base_marker) @ T_base_camera_j, noise, generator, "8.2")
        B[:, :3, 3] *= scale
        problem.add(name, TARGET_ON_HAND, A, B, **weights_of(noise), source="simulate.cameras")
    X = dict(zip(CAMERAS, T_base_camera, strict=True))
    return Simulation(problem, X=X, Y={TARGET_ON_HAND: T_HAND_MARKER.copy()}, scale=scale)


def fixed_camera_poses() -> Array:
    """T_base_camera of the four cameras, (4, 4, 4).

    The z axis (optical) points from the camera to the origin of i. The y axis is (0, 1, 0) where this is orthogonal to
    z, and (-1, 0, -1)/sqrt 2 elsewhere; x = y cross z.
    """
    positions = np.array(CAMERA_POSITIONS_IN_I_M)
    z = -positions / np.linalg.norm(positions, axis=1, keepdims=True)
    upright = np.abs(z[:, 1:2]) < 1e-12
    y = np.where(upright, [0.0, 1.0, 0.0], np.array([-1.0, 0.0, -1.0]) / math.sqrt(2.0))
    T_i_camera = pose(np.stack([np.cross(y, z), y, z], axis=2), positions)
    return T_BASE_I @ T_i_camera


def hand_trajectory() -> Array:
    """T_base_marker of the 108 poses, (108, 4, 4): a 3 x 3 x 3 grid over +-0.6 m at each of four orientations.

    In orientation k the z axis points from the grid point to point k of the line, y along z cross the line's direction,
    x = y cross z. Then the marker is turned about its own z by 2 pi k/3.
    """
    grid = np.stack(np.meshgrid(GRID_M, GRID_M, GRID_M, indexing="ij"), axis=-1).reshape(-1, 3)
    points = np.array(LOOK_AT_IN_I_M)
    line = points[-1] - points[0]
    T_i_marker = []
    for k, point in enumerate(points):
        z = point - grid
        z /= np.linalg.norm(z, axis=1, keepdims=True)
        y = np.cross(z, line)
        y /= np.linalg.norm(y, axis=1, keepdims=True)
        turn = rotations_of_vectors([0.0, 0.0, 2.0 * math.pi * k / 3.0])
        T_i_marker.append(pose(np.stack([np.cross(y, z), y, z], axis=2) @ turn, grid))
    T_base_marker: Array = T_BASE_I @ np.concatenate(T_i_marker)
    return T_base_marker
