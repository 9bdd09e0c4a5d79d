"""Section 8.2 of the RWHEC paper: four fixed cameras watch a target on a robot's hand.

**Roles.** The paper writes A X_j = Y B with X_j = T_base_camera_j, Y = T_hand_target, A = T_hand_base, and puts the
noise on B = T_target_camera_j. This library puts the noise on T_sensor_target. So, to reproduce the paper, the
*cameras* are entered as ``target``s ("camera0" ... "camera3", carried by the base, errors t_x and r_x of Tables 4 and
5, all four pooled), and the target's mounting as ``sensor`` ("marker", carried by the hand, errors t_y and r_y).
:func:`gtsam_rwhec.simulate.general` puts the noise on the camera's own measurement.

The paper gives the geometry in a frame i, at T_base_i. Only the noise is random.
"""

from __future__ import annotations

import math

import numpy as np
from rwhec_factors.se3 import inverse, pose

from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.problem.problem import Problem
from gtsam_rwhec.simulate.noise import Noise, Seed, perturb, weights_of
from gtsam_rwhec.simulate.scales import SHARED_SCALE
from gtsam_rwhec.simulate.simulation import Simulation
from gtsam_rwhec.simulate.transforms import rotations_of_vectors

CAMERAS = ("camera0", "camera1", "camera2", "camera3")
MARKER = "marker"

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

    Parameters
    ----------
    noise : Noise or None
        Noise on B = T_marker_camera, as in :func:`gtsam_rwhec.simulate.sphere`. ``released`` noise reproduces Tables 4
        and 5.
    seed : int or numpy.random.Generator
        Seed, or a generator to draw the noise from.
    monocular : bool
        The problem has one unknown scale, as in :func:`gtsam_rwhec.simulate.sphere`.
    keep_measurements : bool
        Passed to :class:`gtsam_rwhec.Problem`.

    Returns
    -------
    Simulation
        With four targets, "camera0" ... "camera3", and one sensor, "marker" (the module says why).
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
        problem.add(name, MARKER, A, B, **weights_of(noise), source="simulate.cameras")
    X = dict(zip(CAMERAS, T_base_camera, strict=True))
    return Simulation(problem, X=X, Y={MARKER: T_HAND_MARKER.copy()}, scale=scale)


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
