"""What measurements at poses of the carriers tell: rows of a linear model, whitened, without the error of A.

At a pose A target j is seen by sensor k as B = Y^-1 A X. With right perturbations x, y and a of X, Y and A the error of
what is seen is, to first order,

    e = H (x - Ad(B^-1) y + Ad(X^-1) a) + H_s ds + H_c dc

in the axes of the target, with its scale s and the camera's parameters c. H are the derivatives of the corners in
pixels over their deviation (`corner_residuals`), or, without a camera, the inverse root of B's covariance. All that is
seen at one pose shares the error a of A, whose deviations are rows of their own: a triangular factor of all rows, with
a first, leaves W, the rows in which a is not (square-root information, Bierman 1977). So W'W is what the pose adds.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from rwhec_factors import se3

from gtsam_rwhec.capture.plan_cell import Cell
from gtsam_rwhec.fitting.corner_residuals import Stack, linearised
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.problem.measurements import Pair
from gtsam_rwhec.problem.problem import Problem
from gtsam_rwhec.results.linear_model import derivatives


def predicted(cell: Cell, pair: Pair, A: Array) -> Array:
    """T_sensor_target (N, 4, 4) at poses A (N, 4, 4), true metres."""
    return np.asarray(se3.inverse(cell.Y[pair.sensor][None]) @ A @ cell.X[pair.target])


def by_corners(cell: Cell, pair: Pair, A: Array, points: Array) -> tuple[Array, Array, Array, Array]:
    """Pixels (N, n, 2) of points (n, 3) of a board, and derivatives (N, 2n, m) by B, the scale, and the camera."""
    number, camera = len(points), cell.kit.cameras[pair.sensor]
    stack = Stack(
        (pair.target,), pair.sensor, np.zeros(len(A), dtype=np.int64), np.arange(len(A)),
        (points / cell.scale[pair.target])[None], np.zeros((len(A), number, 2)),
        np.ones((len(A), number), dtype=bool), camera,
    )  # fmt: skip
    at = linearised(stack, cell.X[pair.target], cell.Y[pair.sensor], A, camera.parameters, np.zeros(4))
    # The true size is the stated one over the scale.
    by_scale = -at.by_shape[:, :, :1] / cell.scale[pair.target]
    return at.residual.reshape(len(A), number, 2), at.by_B, by_scale, at.by_camera


def _own_rows(cell: Cell, pair: Pair, A: Array) -> tuple[Array, Array, Array]:
    """Whitened rows of what a sensor sees of a target at poses A: derivatives (N, q, m) by B, scale and camera."""
    noise = cell.noise_of(pair)
    if cell.has_corners(pair):
        _, *parts = by_corners(cell, pair, A, cell.kit.boards[pair.target])
        widths = np.cumsum([part.shape[2] for part in parts])[:-1]
        R = _triangle(np.concatenate(parts, axis=2) / cell.kit.corner_px)
        by_B, by_scale, by_camera = np.split(R, widths, axis=2)
        return by_B / np.repeat(noise, 3), by_scale / noise[1], by_camera
    J = derivatives(predicted(cell, pair, A), cell.scale[pair.target]) / np.repeat(noise, 3)[:, None]
    return J[:, :, :6], J[:, :, 12:], np.zeros((len(A), 6, 0))


def rows_at(cell: Cell, A: Array, seen: Mapping[Pair, np.ndarray]) -> Array:
    """W (N, r, d), whose W'W is the information that each pose A (N, 4, 4) adds.

    ``seen`` (N,) has by pair whether the sensor sees the target, or how probably: all that is above 0 counts.
    """
    parts, carriers = [], []
    for pair, probability in seen.items():
        where = probability > 0.0
        if not where.any():
            continue
        by_B, by_scale, by_camera = (_scattered(part, where) for part in _own_rows(cell, pair, A[where]))
        B = predicted(cell, pair, A)
        J = by_frames(cell, pair, B, by_B)
        scale = "scale" if "scale" in cell.slots else f"scale:{pair.target}"
        for name, part in ((scale, by_scale), (f"intrinsics:{pair.sensor}", by_camera)):
            if name in cell.slots:
                J[:, :, cell.slots[name]] += part
        parts.append(J)
        if (noise := cell.carrier_noise) is not None:
            frame = cell.X[pair.target] if noise.about == "targetcarrier" else A @ cell.X[pair.target]
            moved = se3.adjoint(se3.inverse(np.broadcast_to(frame, A.shape)))
            carriers.append(by_B @ moved * np.repeat([noise.rotation_rad, noise.translation_m], 3))
    if not parts:
        return np.zeros((len(A), 1, cell.dimension))
    rows = np.concatenate(parts, axis=1)
    if carriers:
        own = np.concatenate([np.tile(np.eye(6), (len(A), 1, 1)), np.zeros((len(A), 6, cell.dimension))], axis=2)
        both = np.concatenate([own, np.concatenate([np.concatenate(carriers, axis=1), rows], axis=2)], axis=1)
        rows = _triangle(both)[:, 6:, 6:]
    elif rows.shape[1] > cell.dimension:
        rows = _triangle(rows)
    return np.asarray(np.sqrt(cell.share) * rows)


def by_frames(cell: Cell, pair: Pair, B: Array, by_B: Array) -> Array:
    """Derivatives (N, q, d) by all unknowns of what has the derivatives (N, q, 6) by B: those by its two frames."""
    J = np.zeros((*by_B.shape[:2], cell.dimension))
    if pair.target in cell.slots:
        J[:, :, cell.slots[pair.target]] = by_B
    if pair.sensor in cell.slots:
        J[:, :, cell.slots[pair.sensor]] = -(by_B @ se3.adjoint(se3.inverse(B)))
    return J


def _triangle(rows: Array) -> Array:
    """R (N, k, m), upper triangular, with R'R = J'J of rows J (N, r, m)."""
    return np.asarray(np.linalg.qr(rows, mode="r"))


def _scattered(part: Array, where: np.ndarray) -> Array:
    """Rows of the poses that a mask marks, among zeros."""
    full = np.zeros((len(where), *part.shape[1:]))
    full[where] = part
    return full


def measured_information(cell: Cell, problem: Problem) -> Array:
    """The information (d, d) of measurements, as a plan would have predicted it: at the poses of the answer.

    Measurements of one stamp share A's error, as in the answer.
    """
    pairs = [pair for pair in problem.pairs if not pair.is_motion]
    raw = [problem.measurements(*pair) for pair in pairs]
    begin = np.cumsum([0, *(len(one.A) for one in raw)])
    keys = np.arange(begin[-1])
    if all(one.stamps_ns is not None for one in raw):
        _, keys = np.unique(np.concatenate([one.stamps_ns for one in raw]), return_inverse=True)
    A = np.zeros((keys.max() + 1, 4, 4))
    seen = {pair: np.zeros(len(A), dtype=bool) for pair in pairs}
    for i, pair in enumerate(pairs):
        at = keys[begin[i] : begin[i + 1]]
        A[at], seen[pair][at] = raw[i].A, True
    W = rows_at(cell, A, seen)
    return np.asarray(np.einsum("nij,nik->jk", W, W))
