"""Covariances (6, 6) of poses, moved between frames and conventions.

Everywhere in this library a covariance of T_a_b is the covariance of xi in T_a_b Expmap(xi). This is GTSAM's right
perturbation [omega (rad), v (m)], in b's axes and about b's origin. All conversions are of first order (Barfoot, State
Estimation for Robotics, Section 7.3). Ad is GTSAM's adjoint: T Expmap(xi) T^-1 = Expmap(Ad_T xi).
"""

from __future__ import annotations

import gtsam
import numpy as np
from numpy.typing import ArrayLike

from gtsam_rwhec.errors import NoiseError
from gtsam_rwhec.geometry.poses import Array, PoseLike, one_transform

#: [omega, v] to [v, omega] and back.
SWAP = np.r_[3:6, 0:3]


def left_of_right(T_a_b: gtsam.Pose3, covariance: ArrayLike) -> Array:
    """Covariance of a left perturbation Expmap(xi) T_a_b, in a's axes about a's origin, from a right perturbation's."""
    return _turned(T_a_b.AdjointMap(), covariance)


def right_of_left(T_a_b: gtsam.Pose3, covariance: ArrayLike) -> Array:
    """Covariance of the right perturbation T_a_b Expmap(xi), from a left perturbation's."""
    return _turned(T_a_b.inverse().AdjointMap(), covariance)


def of_inverse(T_a_b: gtsam.Pose3, covariance: ArrayLike) -> Array:
    """Covariance of T_b_a from the covariance of T_a_b: (T Expmap(xi))^-1 = T^-1 Expmap(-Ad_T xi)."""
    return left_of_right(T_a_b, covariance)


def of_composition(T_b_c: gtsam.Pose3, covariance_a_b: ArrayLike, covariance_b_c: ArrayLike) -> Array:
    """Covariance of T_a_c = T_a_b T_b_c, in c's frame, from the covariances of two independent poses."""
    return right_of_left(T_b_c, covariance_a_b) + checked(covariance_b_c)


def relative_jacobian(T_a_b: gtsam.Pose3, T_a_c: gtsam.Pose3) -> Array:
    """Jacobian (6, 12) of T_b_c = T_a_b^-1 T_a_c's perturbation by the perturbations of T_a_b and T_a_c, stacked.

    To first order, T_b_c moves to T_b_c Expmap(-Ad(T_b_c^-1) xi_b + xi_c).
    """
    T_c_b = T_a_c.inverse().compose(T_a_b)
    return np.hstack([-T_c_b.AdjointMap(), np.eye(6)])


def ros_of_right(T_a_b: gtsam.Pose3, covariance: ArrayLike) -> Array:
    """Covariance of ROS's PoseWithCovariance: [x, y, z, rotations about fixed axes], all along a's axes.

    The errors are of b's origin and of b's axes, as seen from a. Unlike in ``left_of_right``, no rotation is about a's
    origin. A message writes the 36 numbers row by row.
    """
    swapped: Array = _turned(np.kron(np.eye(2), T_a_b.rotation().matrix()), covariance)[np.ix_(SWAP, SWAP)]
    return swapped


def right_of_ros(T_a_b: gtsam.Pose3, covariance: ArrayLike) -> Array:
    """GTSAM's covariance from a ROS PoseWithCovariance's, which has the translation first, along a's axes."""
    return _turned(np.kron(np.eye(2), T_a_b.rotation().matrix().T), checked(covariance)[np.ix_(SWAP, SWAP)])


def error_of(estimate: gtsam.Pose3, T_a_b: PoseLike) -> Array:
    """The error xi (6,) that an estimate's covariance describes: T_a_b = estimate Expmap(xi).

    Raises `PoseError` if T_a_b is not a valid pose.
    """
    truth = gtsam.Pose3(one_transform(T_a_b, "the pose to compare with"))
    return gtsam.Pose3.Logmap(estimate.inverse().compose(truth))


def standard_deviations(covariance: ArrayLike) -> tuple[Array, Array]:
    """Standard deviations about the covariance's axes (3,), degrees, and along them (3,), millimetres."""
    sigma = np.sqrt(np.diagonal(checked(covariance)))
    return np.degrees(sigma[:3]), 1e3 * sigma[3:]


def checked(covariance: ArrayLike) -> Array:
    """A covariance as a (6, 6) array; a NoiseError for another shape, or a variance that is negative or NaN."""
    array = np.asarray(covariance, dtype=np.float64)
    if array.shape != (6, 6):
        raise NoiseError(f"a covariance of a pose is 6 x 6 [rotation, translation]; this one has shape {array.shape}")
    variances = np.diagonal(array)
    if not (variances >= 0.0).all():
        raise NoiseError(f"the covariance has variances {variances}; give variances that are not negative")
    return array


def _turned(by: Array, covariance: ArrayLike) -> Array:
    """by Sigma by'; a NoiseError for infinite variances, which can be written only in the axes of their own frame."""
    array = checked(covariance)
    if not np.isfinite(array).all():
        raise NoiseError(
            "the covariance is infinite along a free direction and cannot be written in another frame's axes; "
            "turn the marginal information instead (Refined.information)"
        )
    return by @ array @ by.T
