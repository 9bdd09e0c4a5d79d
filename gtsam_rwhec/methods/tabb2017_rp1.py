"""Tabb and Ahmad Yousef 2017, rp1: reprojection errors over rotations' parameters and translations, intrinsics held.

::

    rp1 = sum_c w_c sum_images sum_corners |u(Y_c^-1 A X p) - u|^2,    w_c = fewest images of a camera / camera c's

One residual of two rows a corner, by Levenberg-Marquardt (theirs: Ceres, dense QR, no robust loss). The weights, which
keep a camera with many images from outvoting one with few, are those of the authors' released code; with as many images
of each camera they are 1. Here the rows of all corners are computed at once.
"""

from __future__ import annotations

from collections import Counter

import numpy as np

from gtsam_rwhec.errors import OptionError
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.methods.corner_costs import Corners, Minimum
from gtsam_rwhec.methods.levenberg_marquardt import Linearised, descend
from gtsam_rwhec.methods.tabb2017 import CHARTS, Parameterisation


def weights_of(corners: Corners) -> dict[str, float]:
    """The weight of a squared residual by sensor."""
    images: Counter[str] = Counter()
    for stack in corners.stacks:
        images[stack.sensor] += len(stack.instant)
    fewest = min(images.values())
    return {sensor: fewest / count for sensor, count in images.items()}


def minimum(
    corners: Corners, start: Array, max_iterations: int, parameterisation: Parameterisation = "axis-angle"
) -> Minimum:
    """A local minimum of half of rp1 over corner_px^2, from frames (n, 4, 4); OptionError for an unknown chart."""
    if parameterisation not in CHARTS:
        raise OptionError(f"tabb2017_rp1: {parameterisation!r} is not one of {', '.join(map(repr, CHARTS))}")
    to_parameters, _ = CHARTS[parameterisation]
    p = np.concatenate([to_parameters(start[:, :3, :3]), start[:, :3, 3]], axis=1)
    weights = weights_of(corners)
    found = descend(
        lambda point: linear_model(corners, weights, point, parameterisation),
        lambda point, step: point + step.reshape(point.shape),
        p,
        max_iterations,
    )
    frames, _ = frames_of(found.point, parameterisation)
    return Minimum(frames, found.cost, found.iterations, found.converged)


def frames_of(p: Array, parameterisation: Parameterisation) -> tuple[Array, Array]:
    """Poses (n, 4, 4) of parameters (n, k + 3), and their right perturbations [omega, v] (n, 6, k + 3) by them."""
    _, chart = CHARTS[parameterisation]
    k = p.shape[1] - 3
    R, by_p = chart(p[:, :k])
    n = len(p)
    frames = np.tile(np.eye(4), (n, 1, 1))
    frames[:, :3, :3], frames[:, :3, 3] = R, p[:, k:]
    # vec stacks columns: entry 3 c + r is R[r, c]
    turned = np.einsum("nri,nrck->nick", R, by_p.reshape(n, 3, 3, k).transpose(0, 2, 1, 3))  # R' dR
    tangents = np.zeros((n, 6, k + 3))
    tangents[:, 0, :k], tangents[:, 1, :k], tangents[:, 2, :k] = turned[:, 2, 1], turned[:, 0, 2], turned[:, 1, 0]
    tangents[:, 3:, k:] = R.transpose(0, 2, 1)
    return frames, tangents


def linear_model(
    corners: Corners, weights: dict[str, float], p: Array, parameterisation: Parameterisation
) -> Linearised:
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
