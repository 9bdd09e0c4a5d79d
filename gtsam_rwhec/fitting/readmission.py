"""Images whose corners agree with the answer although their poses were left out as outliers.

The pose of a board in one image is uncertain by its tilt, its distance and its place, and by intrinsics that are not
yet known: that makes outliers of good images. Their corners tell better. An image's corners r (2n) have, about the
answer and with the measured A, the covariance

    F = s^2 I + t^2 P P' + J_A S J_A' + J C J',

with the corners' own noise s, what they share, t P, the noise S of A, and the covariance C of the answer's unknowns;
r' F^-1 r is chi-square.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from scipy.special import chdtri

from gtsam_rwhec.fitting.corner_patterns import OF_AN_IMAGE, patterns
from gtsam_rwhec.fitting.corner_residuals import Stack, stacks_of
from gtsam_rwhec.fitting.corners_refined import CornersRefined
from gtsam_rwhec.fitting.observations import Observations
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.problem.measurements import Pair

#: Of good images, one in so many is farther off by chance.
BY_CHANCE = 1e-4


def agreeing_by_corners(
    observations: Observations, kept: Mapping[Pair, np.ndarray], refined: CornersRefined
) -> dict[Pair, np.ndarray]:
    """Which images (V,) of each pair agree: those that were kept, and those whose corners agree with the answer.

    An image agrees that is no farther off than the farthest of its pair that was kept, or than chance has it.

    Parameters
    ----------
    observations : Observations
        All images, in the order of `kept`.
    refined : CornersRefined
        The answer from those that were kept.
    """
    cameras = {name: refined.intrinsics[name].camera for name in observations.sensors if name in refined.Y}
    views = {at: v for at, v in observations.views.items() if at[0] in refined.X and at[1] in cameras}
    stacks, A = stacks_of(replace(observations, cameras=cameras, views=views), refined.graph.model.kind_of)
    found = dict(kept)
    for stack in stacks:
        size = 2 * stack.known.sum(axis=1)
        share, chance = _squares(stack, A, refined) / np.maximum(size, 1), chdtri(size, BY_CHANCE) / np.maximum(size, 1)
        for name, at in stack.pairs:
            pair = Pair(*name)
            limit = np.maximum(chance[at], share[at][kept[pair]].max(initial=0.0))
            found[pair] = kept[pair] | (share[at] <= limit)
    return found


def _squares(stack: Stack, A: Array, refined: CornersRefined) -> Array:
    """r' F^-1 r (V,) of each image, by (I + M'M)^-1 with M = [J_A S^1/2, J C^1/2] / s."""
    model = replace(refined.graph.model, stacks=(stack,), A=A)
    point = replace(refined.point, A=A)
    rows = model.linearised(stack, point)
    J = np.concatenate(list(model.by_unknown(stack, rows).values()), axis=2)
    index = model.columns(stack, refined.slots)[:, : J.shape[2]]
    values, vectors = np.linalg.eigh(refined.joint[index[:, :, None], index[:, None]])
    M = J @ stack.each(vectors * np.sqrt(np.maximum(values, 0.0))[:, None])
    if refined.noise.carrier is not None:
        M = np.concatenate([M, rows.by_A @ model.to_right[stack.instant] * refined.noise.carrier], axis=2)
    common = refined.noise.common_px * patterns(model, stack, point, OF_AN_IMAGE)
    M = np.concatenate([M, common], axis=2) / refined.noise.corner_px
    r = np.where(np.isfinite(rows.residual), rows.residual, 1e6) / refined.noise.corner_px
    Mr = np.einsum("vni,vn->vi", M, r)
    inner = np.eye(M.shape[2]) + M.transpose(0, 2, 1) @ M
    squares: Array = (r**2).sum(axis=1) - (Mr * np.linalg.solve(inner, Mr[..., None])[..., 0]).sum(axis=1)
    return squares
