"""Which way is up: the ground's normal as given, or the axis that a vehicle on a plane turns about."""

from __future__ import annotations

import numpy as np

from gtsam_rwhec.errors import OptionError
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.odometry.given import Given
from gtsam_rwhec.odometry.window_motions import WindowMotions

#: An axis is taken as up where it is within this angle of the reference's z axis, or of the opposite of its y axis.
NEAR_RAD = np.radians(40.0)


def up_direction(given: Given, windows: WindowMotions, variances: Array, reference: str) -> tuple[Array, float]:
    """The ground's normal (3,) in the frame of sensor 0, up, and its standard deviation in rad.

    Without a given ground it is the axis about which sensor 0 turned most. Its sign is that of z, or, in an optical
    frame (z forward, y down), that against y.

    Raises
    ------
    OptionError
        Heights are given without the ground, and the turning axis is near neither.
    """
    if given.ground is not None:
        normal = np.asarray(given.ground.normal, dtype=float)
        return normal / np.linalg.norm(normal), given.ground.sigma_rad
    axis, sigma = turning_axis(windows, variances)
    if abs(axis[2]) > np.cos(NEAR_RAD):
        axis = axis * np.sign(axis[2])
    elif abs(axis[1]) > np.cos(NEAR_RAD):
        axis = -axis * np.sign(axis[1])
    elif given.heights_m:
        raise OptionError(
            f"heights are given, and the vehicle turned about ({', '.join(f'{x:.2f}' for x in axis)}) of {reference}'s "
            "frame, which is near neither its z axis nor its y axis: nothing says which way is up. Give the ground, "
            "with its normal in that frame"
        )
    return axis, sigma


def turning_axis(windows: WindowMotions, variances: Array) -> tuple[Array, float]:
    """The axis (3,) about which sensor 0 turned most, and its standard deviation in rad.

    A plane's normal is that axis up to noise. What the vehicle turns about other axes beyond its noise says that the
    ground is no plane: then the axis is off by chance, as the mean of ten drives' parts would be.
    """
    used = windows.used[0]
    w = windows.rotation_vectors()[0, used]
    square, axes = np.linalg.eigh(w.T @ w)
    noise = float((variances[0, 0] * windows.length[0, used]).sum())
    of_noise = np.sqrt(noise / len(w) / max(square[2], 1e-300))
    beyond = max(float(square[1]) - 1.3 * noise, 0.0)
    return axes[:, 2], float(np.hypot(of_noise, np.sqrt(beyond / max(square[2], 1e-300) / 10.0)))


def upside_down(normal: Array, T: Array) -> np.ndarray:
    """(m,) for sensors at T (m, 4, 4): 1 where its own axes say that ``normal`` is down, -1 where up, 0 where neither.

    As `up_direction` reads them: z is up; or, where it is level, y is down.
    """
    along = np.einsum("mij,i->mj", T[:, :3, :3], normal)
    limit = np.cos(NEAR_RAD)
    by_z = np.where(np.abs(along[:, 2]) > limit, -np.sign(along[:, 2]), 0.0)
    by_y = np.where(np.abs(along[:, 1]) > limit, np.sign(along[:, 1]), 0.0)
    said: np.ndarray = np.where(by_z != 0.0, by_z, by_y)
    return said
