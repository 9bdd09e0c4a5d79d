"""Covariances of poses from one convention and one frame to another.

Everywhere in this library a covariance of T_a_b is that of xi in T_a_b Expmap(xi): GTSAM's right perturbation, in b's
axes and about b's origin, rotation first, [omega (rad), v (m)]. First order throughout (Barfoot, State Estimation for
Robotics, Section 7.3): Ad is GTSAM's adjoint, T Expmap(xi) T^-1 = Expmap(Ad_T xi).
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
    """Of a left perturbation Expmap(xi) T_a_b, in a's axes and about a's origin, from the right one's (6, 6)."""
    return _turned(T_a_b.AdjointMap(), covariance)


def right_of_left(T_a_b: gtsam.Pose3, covariance: ArrayLike) -> Array:
    """Of the right perturbation, from a left one's (6, 6)."""
    return _turned(T_a_b.inverse().AdjointMap(), covariance)


def of_inverse(T_a_b: gtsam.Pose3, covariance: ArrayLike) -> Array:
    """Of T_b_a's right perturbation (6, 6), from T_a_b's: (T Expmap(xi))^-1 = T^-1 Expmap(-Ad_T xi)."""
    return left_of_right(T_a_b, covariance)


def of_composition(T_b_c: gtsam.Pose3, covariance_a_b: ArrayLike, covariance_b_c: ArrayLike) -> Array:
    """Of T_a_c = T_a_b T_b_c's right perturbation (6, 6), the two being independent; in c's frame."""
    return right_of_left(T_b_c, covariance_a_b) + checked(covariance_b_c)


def relative_jacobian(T_a_b: gtsam.Pose3, T_a_c: gtsam.Pose3) -> Array:
    """(6, 12): how T_b_c = T_a_b^-1 T_a_c's right perturbation follows from those of T_a_b and T_a_c, stacked.

    T_b_c Expmap(-Ad(T_b_c^-1) xi_b + xi_c) to first order.
    """
    T_c_b = T_a_c.inverse().compose(T_a_b)
    return np.hstack([-T_c_b.AdjointMap(), np.eye(6)])


def ros_of_right(T_a_b: gtsam.Pose3, covariance: ArrayLike) -> Array:
    """As ROS's PoseWithCovariance has it (6, 6): [x, y, z, rotations about fixed axes], all along a's axes.

    The position's error and the rotation's are those of b's origin and axes as seen from a; unlike ``left_of_right``,
    nothing is about a's origin. Row-major when written as a message's 36 numbers.
    """
    R = T_a_b.rotation().matrix()
    axes = np.zeros((6, 6))
    axes[:3, :3] = axes[3:, 3:] = R
    swapped: Array = _turned(axes, covariance)[np.ix_(SWAP, SWAP)]
    return swapped


def right_of_ros(T_a_b: gtsam.Pose3, covariance: ArrayLike) -> Array:
    """GTSAM's (6, 6) from a ROS PoseWithCovariance's (6, 6), translation first, along a's axes."""
    Rt = T_a_b.rotation().matrix().T
    axes = np.zeros((6, 6))
    axes[:3, :3] = axes[3:, 3:] = Rt
    return _turned(axes, checked(covariance)[np.ix_(SWAP, SWAP)])


def error_of(estimate: gtsam.Pose3, T_a_b: PoseLike) -> Array:
    """xi (6,) with T_a_b = estimate Expmap(xi): what a covariance of the estimate is the covariance of.

    Raises
    ------
    PoseError
        When T_a_b is no pose.
    """
    truth = gtsam.Pose3(one_transform(T_a_b, "the pose to compare with"))
    xi: Array = gtsam.Pose3.Logmap(estimate.inverse().compose(truth))
    return xi


def standard_deviations(covariance: ArrayLike) -> tuple[Array, Array]:
    """(3,) in degrees about, and (3,) in millimetres along, the axes that the covariance is in; rotation first."""
    sigma = np.sqrt(np.diagonal(checked(covariance)))
    return np.degrees(sigma[:3]), 1e3 * sigma[3:]


def checked(covariance: ArrayLike) -> Array:
    """A (6, 6) array.

    Raises
    ------
    NoiseError
        For another shape, or variances that are negative or no numbers.
    """
    array = np.asarray(covariance, dtype=np.float64)
    if array.shape != (6, 6):
        raise NoiseError(f"a covariance of a pose is 6 x 6 [rotation, translation]; this one has shape {array.shape}")
    variances = np.diagonal(array)
    if not (variances >= 0.0).all():
        raise NoiseError(f"the covariance has variances {variances}; they cannot be negative")
    return array


def _turned(by: Array, covariance: ArrayLike) -> Array:
    """by Sigma by'. Infinite variances stay with the axes that they reach."""
    array = checked(covariance)
    if np.isfinite(array).all():
        turned: Array = by @ array @ by.T
        return turned
    raise NoiseError(
        "the covariance is infinite along a free direction, which another frame's axes cannot hold; "
        "turn the marginal information instead (Refined.information)"
    )
