"""Tabb's rp1 and Evangelista's graph as their authors solve them: by a general solver of least squares.

Their solvers (Ceres, g2o) are compiled, and have a residual a corner. Here they are ``scipy.optimize.least_squares``,
and the residuals of all corners are computed at once by numpy, which is the most that a program in Python can do for
them. As in their code, a corner behind its camera is projected like any other.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from rwhec_factors import se3
from scipy.optimize import least_squares
from scipy.sparse import block_diag, csr_matrix, hstack, vstack

from gtsam_rwhec.fitting.corner_residuals import Stack
from gtsam_rwhec.methods.corner_methods import Corners, edges, frames_of

Array = np.ndarray
#: Of scipy's tolerances; Ceres has 1e-6 for the cost, which leaves 1e-4 of a deviation.
TOLERANCE = 1e-10


@dataclass(frozen=True)
class Found:
    """Half the squares over corner_px^2 where a solver ended, infinite if it failed; and the processor's seconds."""

    cost: float
    seconds: float


def rp1(corners: Corners, start: Array, *, analytic: bool) -> Found:
    """Tabb's rp1 in rotation vectors by MINPACK's Levenberg-Marquardt, with as many images of each camera."""
    p = to_parameters(start)

    def residuals(at: Array) -> Array:
        frames, _ = frames_of(at.reshape(p.shape), "axis-angle")
        parts = []
        for stack in corners.stacks:
            i, j = corners.frames_of(stack)
            B = se3.inverse(frames[j]) @ corners.A[stack.instant] @ frames[i]
            parts.append(errors(stack, B)[0].ravel() / corners.corner_px)
        return np.concatenate(parts)

    def jacobian(at: Array) -> Array:
        frames, tangents = frames_of(at.reshape(p.shape), "axis-angle")
        parts = []
        for stack in corners.stacks:
            i, j = corners.frames_of(stack)
            B = se3.inverse(frames[j]) @ corners.A[stack.instant] @ frames[i]
            by_B = errors(stack, B)[1] / corners.corner_px
            J = np.zeros((by_B.shape[0] * by_B.shape[1], p.size))
            J[:, 6 * i : 6 * i + 6] = (by_B @ tangents[i]).reshape(-1, 6)
            J[:, 6 * j : 6 * j + 6] = (-by_B @ se3.adjoint(se3.inverse(B)) @ tangents[j]).reshape(-1, 6)
            parts.append(J)
        return np.concatenate(parts)

    tolerances = {"ftol": TOLERANCE, "xtol": TOLERANCE, "gtol": TOLERANCE}
    return timed(
        lambda: least_squares(residuals, p.ravel(), jac=jacobian if analytic else "2-point", method="lm", **tolerances)
    )


def evangelista(corners: Corners, start: Array, deviations: tuple[float, float], *, analytic: bool) -> Found:
    """Evangelista's graph, poses as rotation vectors and translations, by a trust region with sparse derivatives."""
    n = len(start)
    images = []
    for stack in corners.stacks:
        i, j = corners.frames_of(stack)
        images.append(se3.inverse(start[j]) @ corners.A[stack.instant] @ start[i])
    p = to_parameters(np.concatenate([start, *images]))
    root = 1.0 / np.repeat(deviations, 3)

    def parts(at: Array) -> tuple[Array, Array, list[tuple[Stack, int, int, slice]]]:
        T, tangents = frames_of(at.reshape(p.shape), "axis-angle")
        found, begin = [], n
        for stack in corners.stacks:
            found.append((stack, *corners.frames_of(stack), slice(begin, begin + len(stack.instant))))
            begin += len(stack.instant)
        return T, tangents, found

    def residuals(at: Array) -> Array:
        T, _, stacks = parts(at)
        rows = []
        for stack, i, j, its in stacks:
            rows.append(errors(stack, T[its])[0].ravel() / corners.corner_px)
            rows.append((edges(corners.A[stack.instant], T[i], T[j], T[its])[0] * root).ravel())
        return np.concatenate(rows)

    def jacobian(at: Array) -> csr_matrix:
        T, tangents, stacks = parts(at)
        blocks = []
        for stack, i, j, its in stacks:
            V = len(stack.instant)
            by_B = errors(stack, T[its])[1] @ tangents[its] / corners.corner_px
            _, by_X, by_Y, of_B = edges(corners.A[stack.instant], T[i], T[j], T[its])
            of_frames = np.zeros((V, 6, 6 * n))
            of_frames[..., 6 * i : 6 * i + 6] = root[:, None] * (by_X @ tangents[i])
            of_frames[..., 6 * j : 6 * j + 6] = root[:, None] * (by_Y @ tangents[j])
            of_B = root[:, None] * (of_B @ tangents[its])
            before, after = 6 * (its.start - n), 6 * (len(p) - its.stop)
            for left, right in ((np.zeros((V * by_B.shape[1], 6 * n)), by_B), (of_frames.reshape(-1, 6 * n), of_B)):
                body = block_diag(list(right), format="csr")
                zeros = (csr_matrix((body.shape[0], width)) for width in (before, after))
                blocks.append(hstack([csr_matrix(left), next(zeros), body, next(zeros)], format="csr"))
        return vstack(blocks, format="csr")

    derivatives = {"jac": jacobian} if analytic else {"jac": "2-point", "jac_sparsity": abs(jacobian(p.ravel())) > 0}
    return timed(
        lambda: least_squares(
            residuals, p.ravel(), method="trf", tr_solver="lsmr", x_scale="jac", ftol=TOLERANCE, xtol=TOLERANCE,
            gtol=TOLERANCE, **derivatives,
        )
    )  # fmt: skip


def timed(solve: Callable[[], object]) -> Found:
    """The cost and the processor's time; infinite where the solver gives up."""
    begun = time.process_time()
    try:
        with np.errstate(all="ignore"):
            cost = float(solve().cost)  # type: ignore[attr-defined]
    except (ValueError, np.linalg.LinAlgError):
        cost = np.inf
    return Found(cost, time.process_time() - begun)


def to_parameters(T: Array) -> Array:
    """Rotation vectors and translations (n, 6) of poses (n, 4, 4)."""
    return np.concatenate([se3.so3_logmap(T[:, :3, :3]), T[:, :3, 3]], axis=1)


def errors(stack: Stack, B: Array) -> tuple[Array, Array]:
    """Errors (V, n, 2) in pixels of a stack at poses T_sensor_target, and derivatives (V, 2n, 6) by [omega, v]."""
    P = stack.points @ B[:, :3, :3].transpose(0, 2, 1) + B[:, None, :3, 3]
    x = P[..., :2] / P[..., 2:]
    pixels, by_x = stack.camera.pixel_jacobian(x)
    by_P = np.concatenate([by_x, -(by_x @ x[..., None])], axis=-1) / P[..., 2, None, None]
    by_p = (by_P.reshape(len(B), -1, 3) @ B[:, :3, :3]).reshape(*by_P.shape)
    by_B = np.concatenate([np.cross(stack.points[:, None], by_p), by_p], axis=-1)
    seen = stack.known[..., None]
    return (np.where(seen, pixels - stack.pixels, 0.0), np.where(seen[..., None], by_B, 0.0).reshape(len(B), -1, 6))
