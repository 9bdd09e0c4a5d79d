"""SE(3) for many poses at once, like gtsam.Pose3 for one. Poses (N, 4, 4); tangents (N, 6), [omega, v].

Equations: Barfoot, State Estimation for Robotics (2024), Chapter 8, with GTSAM's order: rotation first.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]

#: Below this angle, rad, series replace quotients whose numerators cancel.
SMALL = 1e-2
#: Above this angle, rad, the axis comes from the rotation's symmetric part: the antisymmetric part is zero at pi.
LARGE = 3.0


def stacked(poses: Any) -> Array:
    """An array, or a list of gtsam.Pose3, as (N, 4, 4)."""
    if isinstance(poses, (list, tuple)) and poses and hasattr(poses[0], "matrix"):
        poses = [pose.matrix() for pose in poses]
    return np.asarray(poses, dtype=np.float64)


def hat(v: Array) -> Array:
    """The matrices (N, 3, 3) with hat(v) w = v x w."""
    result = np.zeros((*v.shape, 3), dtype=v.dtype)
    x, y, z = v[..., 0], v[..., 1], v[..., 2]
    result[..., 0, 1], result[..., 0, 2], result[..., 1, 2] = -z, y, -x
    result[..., 1, 0], result[..., 2, 0], result[..., 2, 1] = z, -y, x
    return result


#: hat(e_1), hat(e_2), hat(e_3): hat(omega) e_i = -hat(e_i) omega, so d (R e_i) = -R hat(e_i) omega.
HATS = hat(np.eye(3))


def pose(R: Any, t: Any) -> Array:
    """T_a_b (..., 4, 4) of rotations (..., 3, 3) and translations (..., 3), whose leading dimensions are broadcast."""
    rotation, translation = np.asarray(R, dtype=np.float64), np.asarray(t, dtype=np.float64)
    T = np.zeros((*np.broadcast_shapes(rotation.shape[:-2], translation.shape[:-1]), 4, 4))
    T[..., :3, :3], T[..., :3, 3], T[..., 3, 3] = rotation, translation, 1.0
    return T


def inverse(T: Array) -> Array:
    """T_b_a (..., 4, 4) from T_a_b."""
    Rt = np.swapaxes(T[..., :3, :3], -1, -2)
    return pose(Rt, -np.einsum("...ij,...j->...i", Rt, T[..., :3, 3]))


def adjoint(T: Array) -> Array:
    """The matrices (N, 6, 6) with T Expmap(xi) T^-1 = Expmap(adjoint(T) xi)."""
    result = np.zeros((len(T), 6, 6))
    R = T[:, :3, :3]
    result[:, :3, :3] = result[:, 3:, 3:] = R
    result[:, 3:, :3] = hat(T[:, :3, 3]) @ R
    return result


def so3_nearest(M: Array) -> Array:
    """The nearest rotations (..., 3, 3) to matrices (..., 3, 3), in the Frobenius norm (Kabsch)."""
    U, _, Vt = np.linalg.svd(M)
    U[..., 2] *= np.sign(np.linalg.det(U @ Vt))[..., None]
    nearest: Array = U @ Vt
    return nearest


def so3_logmap(R: Array) -> Array:
    """Rotation vectors (N, 3) of rotations (N, 3, 3), with angles in [0, pi], accurate near 0 and near pi."""
    half = 0.5 * np.stack([R[:, 2, 1] - R[:, 1, 2], R[:, 0, 2] - R[:, 2, 0], R[:, 1, 0] - R[:, 0, 1]], axis=-1)
    sine = np.linalg.norm(half, axis=1)
    cosine = 0.5 * (np.trace(R, axis1=1, axis2=2) - 1.0)
    angle = np.arctan2(sine, cosine)
    small = sine < 1e-7
    scale = np.where(small, 1.0 + angle**2 / 6.0, angle / np.where(small, 1.0, sine))
    omega: Array = scale[:, None] * half
    for n in np.flatnonzero(angle > LARGE):
        # R + R' = 2 cos I + 2 (1 - cos) a a': the largest column gives the axis, `half` its sign.
        outer = 0.5 * (R[n] + R[n].T) - np.cos(angle[n]) * np.eye(3)
        axis = outer[:, int(np.argmax(np.diagonal(outer)))]
        axis = axis / np.linalg.norm(axis)
        omega[n] = angle[n] * (axis if axis @ half[n] >= 0.0 else -axis)
    return omega


def so3_left_jacobian_inverse(omega: Array) -> Array:
    """The inverse (N, 3, 3) of the SO(3) left Jacobian: I - hat/2 + d hat^2."""
    angle = np.linalg.norm(omega, axis=1)
    t2, small = angle * angle, angle < SMALL
    t = np.where(small, 1.0, angle)
    cot = (1.0 - 0.5 * t * np.cos(0.5 * t) / np.sin(0.5 * t)) / t**2
    d = np.where(small, 1.0 / 12.0 + t2 / 720.0 + t2 * t2 / 30240.0, cot)
    result: Array = (d[:, None] * omega)[:, :, None] * omega[:, None, :] - 0.5 * hat(omega)
    result[:, np.arange(3), np.arange(3)] += (1.0 - d * t2)[:, None]  # W^2 = omega omega' - angle^2 I
    return result


def expmap(xi: Array) -> Array:
    """Poses (N, 4, 4) of tangents (N, 6)."""
    omega = xi[:, :3]
    W = hat(omega)
    W2 = W @ W
    angle = np.linalg.norm(omega, axis=1)
    t2, small = angle * angle, angle < SMALL
    t = np.where(small, 1.0, angle)
    a = np.sinc(angle / np.pi)
    b = np.where(small, 0.5 - t2 / 24.0 + t2 * t2 / 720.0, (1.0 - np.cos(t)) / t**2)[:, None, None]
    c = np.where(small, 1.0 / 6.0 - t2 / 120.0 + t2 * t2 / 5040.0, (t - np.sin(t)) / t**3)[:, None, None]
    R = np.eye(3) + a[:, None, None] * W + b * W2
    left_jacobian = np.eye(3) + b * W + c * W2
    return pose(R, np.einsum("nij,nj->ni", left_jacobian, xi[:, 3:]))


def logmap(T: Array) -> Array:
    """Tangents (N, 6) of poses (N, 4, 4): T = Expmap(xi), with angles in [0, pi]."""
    omega = so3_logmap(T[:, :3, :3])
    v = np.einsum("nij,nj->ni", so3_left_jacobian_inverse(omega), T[:, :3, 3])
    return np.concatenate([omega, v], axis=1)


def right_jacobian_inverse(xi: Array) -> Array:
    """The matrices (N, 6, 6) with Log(Expmap(xi) Expmap(d)) = xi + result d to first order in d.

    The right Jacobian is the left Jacobian at -xi. Its inverse is [[J, 0], [-J Q J, J]]: J is the inverse of the SO(3)
    left Jacobian at -omega, Q the coupling of translation with rotation (Barfoot eq. 8.91, in GTSAM's order).
    """
    omega, v = -xi[:, :3], -xi[:, 3:]
    J = so3_left_jacobian_inverse(omega)
    result = np.zeros((len(xi), 6, 6))
    result[:, :3, :3] = result[:, 3:, 3:] = J
    result[:, 3:, :3] = -J @ _coupling(omega, v) @ J
    return result


def _coupling(omega: Array, v: Array) -> Array:
    """Q(omega, v) of the SE(3) left Jacobian (Barfoot eq. 8.91b), (N, 3, 3)."""
    t = np.linalg.norm(omega, axis=1)
    small = t < 0.1  # differences of fourth order cancel at larger angles
    s = np.where(small, 1.0, t)
    t2 = t * t
    q1 = np.where(small, 1.0 / 6.0 - t2 / 120.0 * (1.0 - t2 / 42.0 * (1.0 - t2 / 72.0)), (s - np.sin(s)) / s**3)
    q2 = np.where(
        small,
        1.0 / 24.0 - t2 / 720.0 * (1.0 - t2 / 56.0 * (1.0 - t2 / 90.0)),
        (s**2 + 2.0 * np.cos(s) - 2.0) / (2.0 * s**4),
    )
    q3 = np.where(
        small,
        1.0 / 120.0 - t2 / 2520.0 * (1.0 - t2 / 48.0 * (1.0 - t2 / 82.5)),
        (2.0 * s - 3.0 * np.sin(s) + s * np.cos(s)) / (2.0 * s**5),
    )
    # With s = omega' v: W V = v omega' - s I, V W = omega v' - s I, W V W = -s W, W^2 = omega omega' - t^2 I.
    dot = (omega * v).sum(axis=1)
    turned = np.cross(omega, np.cross(omega, v))
    result: Array = hat(0.5 * v + ((q2 - q1) * dot)[:, None] * omega + q2[:, None] * turned)
    mixed = (q1[:, None] * v)[:, :, None] * omega[:, None, :]
    result += mixed + mixed.transpose(0, 2, 1)
    result -= ((2.0 * q3 * dot)[:, None] * omega)[:, :, None] * omega[:, None, :]
    result[:, np.arange(3), np.arange(3)] += (2.0 * dot * (q3 * t2 - q1))[:, None]
    return result
