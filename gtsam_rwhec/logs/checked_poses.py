"""Checks of many messages' poses and images, and their poses as (4, 4) and covariances as GTSAM's (6, 6) arrays."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from rwhec_factors import se3

from gtsam_rwhec.geometry.quaternions import to_rotations
from gtsam_rwhec.logs.records import Array

#: A quaternion's norm may be this far from 1. The quaternion is then normalised.
QUATERNION_TOLERANCE = 1e-2
#: A position further away than this, in metres, is refused.
LARGEST_M = 1e12
#: A covariance with a larger entry, m^2 or rad^2, says nothing: it is of a place further away than `LARGEST_M`.
LARGEST_VARIANCE = LARGEST_M**2


def transforms(positions: Array, quaternions_xyzw: Array) -> tuple[Array, dict[int, str]]:
    """Make (N, 4, 4) transforms of (N, 3) positions in metres and (N, 4) quaternions, and say what is wrong, by index.

    A fault is an entry that is not finite, a norm that is not 1, or a position too far away; T is the identity there.
    """
    norms = np.sqrt(np.einsum("ij,ij->i", quaternions_xyzw, quaternions_xyzw))
    # Every comparison with NaN is false, so NaN is a fault.
    good = (np.abs(norms - 1.0) <= QUATERNION_TOLERANCE) & (np.abs(positions) <= LARGEST_M).all(axis=1)
    bad = np.flatnonzero(~good).tolist()
    faults = {i: _fault(positions[i], quaternions_xyzw[i], float(norms[i])) for i in bad}
    if bad:
        positions = np.where(good[:, None], positions, 0.0)
        quaternions_xyzw = np.where(good[:, None], quaternions_xyzw, [0.0, 0.0, 0.0, 1.0])
    return se3.pose(to_rotations(quaternions_xyzw), positions), faults


def _fault(position: Array, quaternion: Array, norm: float) -> str:
    if not (np.isfinite(position).all() and np.isfinite(quaternion).all()):
        return f"position {position.tolist()} or quaternion {quaternion.tolist()} (x, y, z, w) is not finite"
    if not abs(norm - 1.0) <= QUATERNION_TOLERANCE:
        return f"quaternion {quaternion.tolist()} (x, y, z, w) has norm {norm:.6g} in place of 1"
    return f"position {position.tolist()} is further than {LARGEST_M:g} m away"


def gtsam_covariances(T: Array, covariances: Array) -> list[Array | None]:
    """Turn (N, 6, 6) covariances of ROS poses T (N, 4, 4) into GTSAM's.

    ROS has (x, y, z, rotations about the fixed axes x, y, z) in the parent frame: t + d, Exp(phi) R. A right
    perturbation [omega, v] moves (R, t) to (R Exp(omega), t + R v), so omega = R' phi and v = R' d. A covariance that
    is all zeros or has a negative variance (so ROS marks an unknown covariance), is not finite or has entries beyond
    `LARGEST_VARIANCE` becomes None.
    """
    diagonal = np.diagonal(covariances, axis1=1, axis2=2)
    # Every comparison with NaN is false, so NaN is unknown.
    known: NDArray[np.bool_] = np.asarray((np.abs(covariances) <= LARGEST_VARIANCE).all(axis=(1, 2)))
    known &= (diagonal >= 0).all(axis=1) & diagonal.any(axis=1)
    if not known.any():
        return [None] * len(T)
    given = np.where(known[:, None, None], covariances, 0.0)
    symmetric = 0.5 * (given + given.transpose(0, 2, 1))
    # (N, 2, 2, 3, 3) blocks, rotation first
    blocks = symmetric.reshape(-1, 2, 3, 2, 3).transpose(0, 1, 3, 2, 4)[:, ::-1, ::-1]
    R = T[:, None, None, :3, :3]
    right = (R.swapaxes(-1, -2) @ blocks @ R).transpose(0, 1, 3, 2, 4).reshape(-1, 6, 6)
    return [right[i] if is_known else None for i, is_known in enumerate(known.tolist())]


def image_fault(width: int, height: int, step: int, data: bytes) -> str:
    """Say what is wrong with a raw image's size; the text is empty if the data has all rows."""
    if width * height and step * height <= len(data):
        return ""
    return f"image of {width} x {height} pixels, {step} bytes a row, has {len(data)} bytes"
