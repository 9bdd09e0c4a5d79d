"""Methods on corners: Evangelista et al. 2023 and Tabb and Ahmad Yousef's rp1 (2017); intrinsics are held."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np
from rwhec_factors import se3

from gtsam_rwhec.errors import OptionError
from gtsam_rwhec.fitting.corner_residuals import SHAPE, Linear, Stack, linearised, pixel_errors, stacks_of
from gtsam_rwhec.fitting.observations import Observations
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.geometry.quaternions import of_rotations
from gtsam_rwhec.methods.iterative_methods import CHARTS, Parameterisation
from gtsam_rwhec.methods.levenberg_marquardt import Descent, Linearised, descend

Pose = TypeVar("Pose")
#: Boards have their stated shape.
FLAT = np.zeros(SHAPE)


@dataclass(frozen=True, eq=False)
class Corners:
    """Observations as stacks of one target each, with the carriers' poses A (I, 4, 4) of all instants.

    Frames are numbered: targets first, then sensors; `frames` (n, 4, 4) below are their poses X and Y in that order.
    """

    targets: tuple[str, ...]
    sensors: tuple[str, ...]
    stacks: tuple[Stack, ...]
    A: Array
    corner_px: float

    @staticmethod
    def of(observations: Observations) -> Corners:
        """The corners of observations."""
        stacks, A = stacks_of(observations, str)
        return Corners(observations.targets, observations.sensors, stacks, A, observations.corner_px)

    @property
    def number(self) -> int:
        """The number of corners that were seen."""
        return sum(int(stack.known.sum()) for stack in self.stacks)

    def named(self, frames: Sequence[Pose]) -> tuple[dict[str, Pose], dict[str, Pose]]:
        """X and Y by name."""
        n = len(self.targets)
        return dict(zip(self.targets, frames[:n], strict=True)), dict(zip(self.sensors, frames[n:], strict=True))

    def frames_of(self, stack: Stack) -> tuple[int, int]:
        """The numbers of a stack's target and sensor."""
        return self.targets.index(stack.targets[0]), len(self.targets) + self.sensors.index(stack.sensor)

    def rows(self, stack: Stack, frames: Array) -> Linear:
        """Errors of a stack in pixels, with derivatives, by the measured A; infinite behind the camera."""
        i, j = self.frames_of(stack)
        return linearised(stack, frames[i], frames[j], self.A, stack.camera.parameters, FLAT)

    def cost(self, frames: Array) -> float:
        """Half the sum of squared reprojection errors over corner_px^2, by the measured A; infinite behind a camera."""
        total = 0.0
        for stack in self.stacks:
            i, j = self.frames_of(stack)
            error = pixel_errors(stack, frames[i], frames[j], self.A, stack.camera.parameters, FLAT)
            total += 0.5 * float((error**2).sum()) / self.corner_px**2
        return total


#: Deviations (rad, m) of a robot's pose for each pixel of a corner's, where information matrices are the identity.
IDENTITY = (2.0, 1.0)


@dataclass(frozen=True, eq=False)
class Graph:
    """Values of the vertices: X and Y (n, 4, 4), and the images' poses B (V, 4, 4), stack after stack."""

    frames: Array
    B: Array


@dataclass(frozen=True, eq=False)
class Bordered(Linearised):
    """A quadratic model whose images' poses are eliminated: H (m, m) and g (m,) are of the frames alone."""

    #: (V, 6, 6): blocks of the images' poses, C (V, 6, m) those between them and the frames, and g_B (V, 6) the
    #: gradient
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


def evangelista_minimum(
    corners: Corners, start: Array, max_iterations: int, carrier: tuple[float, float] | None = None
) -> Descent[Array]:
    """A local minimum of half of Evangelista's cost, from frames (n, 4, 4).

    The graph extends that of Koide and Menegatti (RA-L 2019). Its vertices are all X and Y, and the target's pose B_i
    in the camera of each image; t is a pose's translation, q its quaternion's vector part::

        sum_corners |u(B_i p) - u|^2 / corner_px^2  +  sum_images |t(D_i) / s_t|^2 + |2 q(D_i) / s_r|^2,
        D_i = A_i^-1 Y B_i X^-1

    `carrier` has the deviations (rad, m) of the robot's poses; None: `IDENTITY` for each pixel of a corner's deviation.
    """
    deviations = carrier or (IDENTITY[0] * corners.corner_px, IDENTITY[1] * corners.corner_px)
    begin = _graph_at(corners, start, corners.A)
    found = descend(lambda graph: graph_model(corners, graph, deviations), _moved, begin, max_iterations)
    return Descent(found.point.frames, found.cost, found.iterations, found.converged)


def cost_at(corners: Corners, frames: Array, A: Array, deviations: tuple[float, float]) -> float:
    """Half the cost where the robot's poses are A (I, 4, 4), not as measured: images' poses are Y^-1 A X."""
    return graph_model(corners, _graph_at(corners, frames, A), deviations).cost


def _graph_at(corners: Corners, frames: Array, A: Array) -> Graph:
    """The graph whose images' poses follow from the frames and the robot's poses A (I, 4, 4)."""
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
    return q * np.where(q[:, 3:] < 0.0, -1.0, 1.0)


def graph_model(corners: Corners, graph: Graph, deviations: tuple[float, float]) -> Linearised:
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
        alone = linearised(own, np.eye(4), np.eye(4), B, stack.camera.parameters, FLAT)
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


def weights_of(corners: Corners) -> dict[str, float]:
    """The weight of a squared residual by sensor."""
    images: Counter[str] = Counter()
    for stack in corners.stacks:
        images[stack.sensor] += len(stack.instant)
    fewest = min(images.values())
    return {sensor: fewest / count for sensor, count in images.items()}


def rp1_minimum(
    corners: Corners, start: Array, max_iterations: int, parameterisation: Parameterisation = "axis-angle"
) -> Descent[Array]:
    """A local minimum of half of rp1 over corner_px^2, from frames (n, 4, 4); OptionError for an unknown chart.

    rp1 = sum_c w_c sum_images sum_corners |u(Y_c^-1 A X p) - u|^2, with w_c = fewest images of a camera / camera c's,
    as in the authors' released code: a camera with many images does not outvote one with few.
    """
    if parameterisation not in CHARTS:
        raise OptionError(f"tabb2017_rp1: {parameterisation!r} is not one of {', '.join(map(repr, CHARTS))}")
    to_parameters, _ = CHARTS[parameterisation]
    p = np.concatenate([to_parameters(start[:, :3, :3]), start[:, :3, 3]], axis=1)
    weights = weights_of(corners)
    found = descend(
        lambda point: rp1_model(corners, weights, point, parameterisation),
        lambda point, step: point + step.reshape(point.shape),
        p,
        max_iterations,
    )
    return replace(found, point=frames_of(found.point, parameterisation)[0])


def frames_of(p: Array, parameterisation: Parameterisation) -> tuple[Array, Array]:
    """Poses (n, 4, 4) of parameters (n, k + 3), and their right perturbations [omega, v] (n, 6, k + 3) by them."""
    _, chart = CHARTS[parameterisation]
    k = p.shape[1] - 3
    R, by_p = chart(p[:, :k])
    n = len(p)
    frames = se3.pose(R, p[:, k:])
    # vec stacks columns: entry 3 c + r is R[r, c]
    turned = np.einsum("nri,nrck->nick", R, by_p.reshape(n, 3, 3, k).transpose(0, 2, 1, 3))  # R' dR
    tangents = np.zeros((n, 6, k + 3))
    tangents[:, 0, :k], tangents[:, 1, :k], tangents[:, 2, :k] = turned[:, 2, 1], turned[:, 0, 2], turned[:, 1, 0]
    tangents[:, 3:, k:] = R.transpose(0, 2, 1)
    return frames, tangents


def rp1_model(corners: Corners, weights: dict[str, float], p: Array, parameterisation: Parameterisation) -> Linearised:
    """Half of rp1 over corner_px^2 at parameters (n, k), its gradient and Gauss-Newton Hessian by them."""
    frames, tangents = frames_of(p, parameterisation)
    n, k = p.shape
    H, g, cost = np.zeros((n * k, n * k)), np.zeros(n * k), 0.0
    for stack in corners.stacks:
        rows = corners.rows(stack, frames)
        if not np.isfinite(rows.residual).all():
            return Linearised(np.inf, g, H)
        i, j = corners.frames_of(stack)
        scale = np.sqrt(weights[stack.sensor]) / corners.corner_px
        J = np.concatenate([rows.by_X @ tangents[i], rows.by_Y @ tangents[j]], axis=2).reshape(-1, 2 * k) * scale
        e = rows.residual.ravel() * scale
        at = np.r_[k * i : k * (i + 1), k * j : k * (j + 1)]
        H[np.ix_(at, at)] += J.T @ J
        g[at] += J.T @ e
        cost += 0.5 * float(e @ e)
    return Linearised(cost, g, H)
