"""Quaternions, positions and covariances of many messages at once: checked, and made (4, 4) and GTSAM's (6, 6)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from gtsam_rwhec.logs.records import Array

#: How far a quaternion's norm may be from 1; nearer ones are normalised.
QUATERNION_TOLERANCE = 1e-2
#: Positions beyond this are no positions.
LARGEST_M = 1e12


def transforms(positions: Array, quaternions_xyzw: Array) -> tuple[Array, dict[int, str]]:
    """Make (N, 4, 4) transforms.

    Parameters
    ----------
    positions : (N, 3), metres
    quaternions_xyzw : (N, 4)

    Returns
    -------
    T : (N, 4, 4)
        Identity where there is a fault.
    faults : dict
        By index, in words: not finite, no unit quaternion.
    """
    norms = np.sqrt(np.einsum("ij,ij->i", quaternions_xyzw, quaternions_xyzw))
    # Comparisons with NaN are false, which is what makes it a fault here.
    good = (np.abs(norms - 1.0) <= QUATERNION_TOLERANCE) & (np.abs(positions) <= LARGEST_M).all(axis=1)
    faults = {}
    if not good.all():
        for i in np.flatnonzero(~good).tolist():
            faults[i] = _fault(positions[i], quaternions_xyzw[i], float(norms[i]))
        positions = np.where(good[:, None], positions, 0.0)
        quaternions_xyzw = np.where(good[:, None], quaternions_xyzw, [0.0, 0.0, 0.0, 1.0])
        norms = np.where(good, norms, 1.0)
    x, y, z, w = (quaternions_xyzw / norms[:, None]).T
    T = np.zeros((len(norms), 4, 4))
    T[:, 0, 0] = 1 - 2 * (y * y + z * z)
    T[:, 0, 1] = 2 * (x * y - z * w)
    T[:, 0, 2] = 2 * (x * z + y * w)
    T[:, 1, 0] = 2 * (x * y + z * w)
    T[:, 1, 1] = 1 - 2 * (x * x + z * z)
    T[:, 1, 2] = 2 * (y * z - x * w)
    T[:, 2, 0] = 2 * (x * z - y * w)
    T[:, 2, 1] = 2 * (y * z + x * w)
    T[:, 2, 2] = 1 - 2 * (x * x + y * y)
    T[:, :3, 3] = positions
    T[:, 3, 3] = 1.0
    return T, faults


def _fault(position: Array, quaternion: Array, norm: float) -> str:
    if not (np.isfinite(position).all() and np.isfinite(quaternion).all()):
        return f"position {position.tolist()} or quaternion {quaternion.tolist()} (x, y, z, w) is not finite"
    if not abs(norm - 1.0) <= QUATERNION_TOLERANCE:
        return f"quaternion {quaternion.tolist()} (x, y, z, w) has norm {norm:.6g} in place of 1"
    return f"position {position.tolist()} is further than {LARGEST_M:g} m away"


def gtsam_covariances(T: Array, covariances: Array) -> list[Array | None]:
    """Turn covariances of ROS poses into GTSAM's.

    ROS has (x, y, z, turns about the fixed axes x, y, z) in the parent frame: t + d, Exp(phi) R. A right perturbation
    [omega, v] moves (R, t) to (R Exp(omega), t + R v), so omega = R' phi and v = R' d.

    Parameters
    ----------
    T : (N, 4, 4)
    covariances : (N, 6, 6)

    Returns
    -------
    list of N
        (6, 6); None where it is all zeros, has a negative variance (ROS's ways of saying unknown), or is not finite.
    """
    diagonal = np.diagonal(covariances, axis1=1, axis2=2)
    known: NDArray[np.bool_] = np.asarray(np.isfinite(covariances).all(axis=(1, 2)))
    with np.errstate(invalid="ignore"):
        known &= (diagonal >= 0).all(axis=1) & diagonal.any(axis=1)
    if not known.any():
        return [None] * len(T)
    order = [3, 4, 5, 0, 1, 2]
    J = np.zeros((int(known.sum()), 6, 6))
    J[:, :3, :3] = J[:, 3:, 3:] = T[known, :3, :3]
    rotation_first = covariances[known][:, order][:, :, order]
    right = J.transpose(0, 2, 1) @ (0.5 * (rotation_first + rotation_first.transpose(0, 2, 1))) @ J
    found = iter(right)
    return [next(found) if is_known else None for is_known in known.tolist()]
