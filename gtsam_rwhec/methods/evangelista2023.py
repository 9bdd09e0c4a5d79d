"""Evangelista et al. 2023: a graph of poses, with an edge a corner and an edge a pose of the robot.

The paper extends the graph of Koide and Menegatti (General hand-eye calibration based on reprojection error
minimization, RA-L 2019) to fixed cameras and to several of them. Its vertices are all X and Y, and the target's pose
B_i in the camera of each image::

    sum_corners |u(B_i p) - u|^2 / corner_px^2  +  sum_images |t(D_i) / s_t|^2 + |2 q(D_i) / s_r|^2,
    D_i = A_i^-1 Y B_i X^-1,

with the translation t and the quaternion's vector part q of a pose. s_r and s_t are the deviations of the robot's
poses. Koide and Menegatti's released tools have the identity as all information matrices and no robust kernels, so
that a pixel weighs as a metre and as two radians: `IDENTITY`. Deviations that the robot has are better.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from rwhec_factors import se3

from gtsam_rwhec.fitting.corner_residuals import linearised
from gtsam_rwhec.fitting.stated_intrinsics import parameters_of
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.geometry.quaternions import of_rotations
from gtsam_rwhec.methods.corner_costs import FLAT, Corners, Minimum
from gtsam_rwhec.methods.levenberg_marquardt import Linearised, descend

#: Deviations (rad, m) of a robot's pose for each pixel of a corner's, where information matrices are the identity.
IDENTITY = (2.0, 1.0)


@dataclass(frozen=True, eq=False)
class Graph:
    """Values of the vertices: X and Y (n, 4, 4), and the images' poses B (V, 4, 4), stack after stack."""

    frames: Array
    B: Array


@dataclass(frozen=True, eq=False)
class Bordered(Linearised):
    """A quadratic model whose images' poses are eliminated: H (m, m) and g (m,) are of the frames alone.

    Attributes
    ----------
    by_B : (V, 6, 6) array
        Blocks of the images' poses, C (V, 6, m) those between them and the frames, and g_B (V, 6) the gradient.
    """

    by_B: Array
    C: Array
    g_B: Array

    def step(self, damping: float) -> Array:
        """Steps of the frames (m,), then of the images' poses (6 V,), by Schur's complement."""
        diagonal = np.diagonal(self.by_B, axis1=1, axis2=2)
        D = self.by_B + damping * diagonal[:, None, :] * np.eye(6)
        solved = np.linalg.solve(D, np.concatenate([self.C, self.g_B[..., None]], axis=2))
        flat, m = self.C.reshape(-1, len(self.g)), len(self.g)
        H = self.H + damping * np.diag(np.diagonal(self.H)) - flat.T @ solved[..., :m].reshape(-1, m)
        g = self.g - flat.T @ solved[..., m].ravel()
        step = -np.linalg.lstsq(H, g, rcond=1e-15)[0]
        return np.concatenate([step, (-solved[..., m] - solved[..., :m] @ step).ravel()])


def minimum(corners: Corners, start: Array, max_iterations: int, carrier: tuple[float, float] | None = None) -> Minimum:
    """A local minimum of half the cost, from frames (n, 4, 4).

    `carrier` has the deviations (rad, m) of the robot's poses; None: `IDENTITY` for each pixel of a corner's deviation.
    """
    deviations = carrier or (IDENTITY[0] * corners.corner_px, IDENTITY[1] * corners.corner_px)
    begin = _graph_at(corners, start, corners.A)
    found = descend(lambda graph: linear_model(corners, graph, deviations), _moved, begin, max_iterations)
    return Minimum(found.point.frames, found.cost, found.iterations, found.converged)


def cost_at(corners: Corners, frames: Array, A: Array, deviations: tuple[float, float]) -> float:
    """Half the cost where the robot's poses are A (I, 4, 4), not as measured: images' poses are Y^-1 A X."""
    return linear_model(corners, _graph_at(corners, frames, A), deviations).cost


def _graph_at(corners: Corners, frames: Array, A: Array) -> Graph:
    """The images' poses as the frames and poses A (I, 4, 4) of the robot have them."""
    B = []
    for stack in corners.stacks:
        i, j = corners.frames_of(stack)
        B.append(se3.inverse(frames[j]) @ A[stack.instant] @ frames[i])
    return Graph(frames, np.concatenate(B))


def _moved(graph: Graph, step: Array) -> Graph:
    moves = se3.expmap(step.reshape(-1, 6))
    n = len(graph.frames)
    return Graph(graph.frames @ moves[:n], graph.B @ moves[n:])


def edges(A: Array, X: Array, Y: Array, B: Array) -> tuple[Array, Array, Array, Array]:
    """Errors [2 q, t] (V, 6) of D = A^-1 Y B X^-1, and their derivatives (V, 6, 6) by X, Y and B."""
    D = se3.inverse(A) @ Y @ B @ se3.inverse(X)
    R = D[:, :3, :3]
    q = _quaternions(R)
    by_D = np.zeros((len(D), 6, 6))  # by right perturbations [omega, v]: 2 dq = (q_w + hat q) omega, dt = R v
    by_D[:, :3, :3] = q[:, 3, None, None] * np.eye(3) + se3.hat(q[:, :3])
    by_D[:, 3:, 3:] = R
    of_X = np.broadcast_to(X, B.shape)
    by_B = by_D @ se3.adjoint(of_X)
    return np.concatenate([2.0 * q[:, :3], D[:, :3, 3]], axis=1), -by_B, by_D @ se3.adjoint(X @ se3.inverse(B)), by_B


def _quaternions(R: Array) -> Array:
    """Quaternions (V, 4) with a positive scalar part, which is last, of rotations (V, 3, 3)."""
    q = of_rotations(R)
    positive: Array = q * np.where(q[:, 3:] < 0.0, -1.0, 1.0)
    return positive


def linear_model(corners: Corners, graph: Graph, deviations: tuple[float, float]) -> Linearised:
    """Half the cost at a graph's values, with its gradient and Gauss-Newton Hessian."""
    m = 6 * len(graph.frames)
    H, g, cost = np.zeros((m, m)), np.zeros(m), 0.0
    by_B, C, g_B = [], [], []
    root = 1.0 / np.repeat(deviations, 3)
    begin = 0
    for stack in corners.stacks:
        V = len(stack.instant)
        i, j = corners.frames_of(stack)
        X, Y, B = graph.frames[i], graph.frames[j], graph.B[begin : begin + V]
        begin += V
        # with X and Y the identity, B takes the place of A
        own = replace(stack, instant=np.arange(V))
        alone = linearised(own, np.eye(4), np.eye(4), B, parameters_of(stack.camera), FLAT)
        if not np.isfinite(alone.residual).all():
            return Linearised(np.inf, g, H)
        r, J = alone.residual / corners.corner_px, alone.by_A / corners.corner_px
        e, e_X, e_Y, e_B = edges(corners.A[stack.instant], X, Y, B)
        e = e * root
        J_frames = np.concatenate([e_X, e_Y], axis=2) * root[:, None]
        J_B = e_B * root[:, None]
        at = np.r_[6 * i : 6 * i + 6, 6 * j : 6 * j + 6]
        H[np.ix_(at, at)] += np.einsum("vrp,vrq->pq", J_frames, J_frames)
        g[at] += np.einsum("vrp,vr->p", J_frames, e)
        by_B.append(J.transpose(0, 2, 1) @ J + J_B.transpose(0, 2, 1) @ J_B)
        of_stack = np.zeros((V, 6, m))
        of_stack[:, :, at] = J_B.transpose(0, 2, 1) @ J_frames
        C.append(of_stack)
        g_B.append(np.einsum("vrp,vr->vp", J, r) + np.einsum("vrp,vr->vp", J_B, e))
        cost += 0.5 * float((r**2).sum() + (e**2).sum())
    return Bordered(cost, g, H, np.concatenate(by_B), np.concatenate(C), np.concatenate(g_B))
