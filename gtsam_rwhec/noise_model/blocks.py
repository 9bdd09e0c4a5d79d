"""Blocks of time: how far the covariance falls short where errors of neighbours are alike and no model holds them.

Within a block of time errors may depend on one another in any way; blocks count as independent. The scores
s_b = sum over the block of J' V^-1 r give the covariance H^-1 (sum_b s_b s_b') H^-1 with H = sum J' V^-1 J (White's
sandwich of 1980, by clusters). Few blocks tell few numbers: the ratio of its variances to those of H^-1, for each
three of a frame.
"""

from __future__ import annotations

import numpy as np

from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.noise_model.components import Component
from gtsam_rwhec.noise_model.settling import Settled, Task

#: So many blocks, and one instant in each at least.
BLOCKS = 10
C = Component


def widening(task: Task, found: Settled) -> Array:
    """By how much (d,) the standard deviations of the unknowns are too small, as blocks of time say; 1 at least."""
    rows, basis, count = found.model.rows, found.model.basis, task.instants.count
    wider = np.ones(len(task.layout.unit))
    if count < 2 * BLOCKS:
        return wider
    sigma = found.fit.sizes.values(found.fit.logs)
    carrier = np.repeat([sigma[C.CARRIER_ROTATION], sigma[C.CARRIER_TRANSLATION]], 3)
    E = rows.twist[found.model.side] * carrier
    root = np.linalg.cholesky(found.model.white(sigma) + E @ E.transpose(0, 2, 1))
    J = np.linalg.solve(root, rows.by_unknowns.by(basis).whole)
    r = np.linalg.solve(root, rows.residual[:, :, None])[:, :, 0]
    p = J.shape[2]
    H = np.linalg.inv(np.einsum("nip,niq->pq", J, J, optimize=True) + found.model.prior_information)
    scores = np.zeros((BLOCKS, p))
    np.add.at(scores, rows.instants.index * BLOCKS // count, np.einsum("nip,ni->np", J, r))
    scores -= scores.mean(axis=0)
    by_blocks = basis @ (H @ (scores.T @ scores) @ H) @ basis.T * (BLOCKS / (BLOCKS - 1.0))
    independent = basis @ H @ basis.T
    for place in task.layout.slots.values():
        whole = np.arange(len(wider))[place]
        for part in np.array_split(whole, max(len(whole) // 3, 1)):
            variance = float(np.trace(independent[np.ix_(part, part)]))
            if variance > 0.0:
                ratio = float(np.trace(by_blocks[np.ix_(part, part)])) / variance
                wider[part] = np.sqrt(max(ratio, 1.0))
    return wider
