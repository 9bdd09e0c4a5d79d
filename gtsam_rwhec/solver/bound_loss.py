"""What a lower bound loses where a gradient does not vanish (``bound``): by a margin of definiteness that is proven.

With Z >= diag(m), for any v and rho = h - Z v: -min 2 h'z + z'Z z <= (2 h - Z v)'v + sum rho^2 / m.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.geometry.rounding import UNIT, gamma
from gtsam_rwhec.solver.block_matrix import BlockFactor
from gtsam_rwhec.solver.curvature import Curvature
from gtsam_rwhec.solver.null_vectors import NullVectors

#: Margins of definiteness as parts of the form's diagonal: the largest that is proven costs least.
ROOMS = (1e-5, 1e-7, 1e-9, 1e-11, 1e-13)
#: A solution by the factor of a proof is improved at most so many times, until it loses this part of the loss.
IMPROVEMENTS = 6
ENOUGH = 1e-6
#: A loss below this part of the value needs no solution at all.
NEXT_TO_NOTHING = 1e-10


@dataclass(frozen=True)
class Room:
    """A margin (13 n + 1,) by which Z is proven to be definite, and the value that losses are compared with."""

    Z: Curvature
    margin: Array
    value: float
    proof: BlockFactor | None  #: the factor of nearly Z - margin, where it was kept

    @staticmethod
    def of(Z: Curvature, margin: Array, value: float) -> Room | None:
        """The room, if it is proven."""
        if Z.has_large_factor:
            return Room(Z, margin, value, None) if Z.is_proven_to_exceed(margin) else None
        proof = Z.proof_that_it_exceeds(margin)
        return None if proof is None else Room(Z, margin, value, proof)

    @staticmethod
    def largest(Z: Curvature, scale: Array, value: float) -> Room | None:
        """The largest room that is proven, of parts of a diagonal ``scale`` (13 n + 1,)."""
        for margin in (*(np.maximum(part * scale, 1e-290) for part in ROOMS), 0.25 * Z.allowance(scale)):
            proven = Room.of(Z, margin, value)
            if proven is not None:
                return proven
        return None

    @cached_property
    def _factor(self) -> BlockFactor | None:
        return self.proof or self.Z.proof_that_it_exceeds(self.margin)

    def solved(self, h: Array, held: np.ndarray) -> Array:
        """Nearly Z^-1 h: the factor's solution, improved where the margin makes it poor. It is zero where held.

        Where zero loses next to nothing, and no factor was kept, it is zero.
        """
        v, rest, size = np.zeros_like(h), h, np.inf
        if self.proof is None and float((h**2 / self.margin).sum()) <= NEXT_TO_NOTHING * abs(self.value):
            return v
        factor = self._factor
        if factor is None:  # it was there before
            return v
        for _ in range(IMPROVEMENTS):
            better = v + factor.solve_vector(rest)
            better[held] = 0.0
            after = h - self.Z.times(better)
            after[held] = 0.0
            after_size = float((after**2 / self.margin).sum())
            if not after_size < size:
                break
            v, rest, size = better, after, after_size
            if size <= ENOUGH * abs(float(h @ v)):
                break
        return v


def loss_along(nulls: NullVectors, root: float, of_nulls: Array, width: Array) -> float:
    """An upper bound on -min of 2 (V'g)'a + a'(V'ZV)a - (root + sum |a_k| of_nulls_k)^2 + root^2, over |a| <= width.

    In a direction in which V'ZV is surely positive no limit is needed.
    """
    k = len(width)
    if k == 0:
        return 0.0
    # (sum |a_k| r_k)^2 <= k sum a_k^2 r_k^2. In units of the limits, so that directions compare.
    curved = nulls.VZV - np.diag(k * of_nulls**2)
    curved = 0.5 * (curved + curved.T) * width[:, None] * width
    slope = (np.abs(nulls.Vg) + nulls.Vg_error + root * of_nulls) * width
    if not (np.isfinite(curved).all() and np.isfinite(slope).all()):
        return np.inf
    values, vectors = np.linalg.eigh(curved)
    unsure = float((nulls.VZV_error * width[:, None] * width).sum()) + 1e-13 * k * float(np.abs(curved).sum())
    loss = 0.0
    for value, vector in zip(values - unsure, vectors.T, strict=True):
        h = float(np.abs(vector) @ slope)
        reach = float(np.abs(vector).sum())
        box = 2.0 * h * reach + max(-float(value), 0.0) * reach**2
        loss += min(box, h * h / float(value)) if value > 0.0 else box
    return loss * (1.0 + 1e-9)


def root_of_loss(room: Room, h: Array, h_error: Array, held: np.ndarray) -> float:
    """The root of an upper bound on -min 2 h'z + z'Z z, over z whose ``held`` entries are zero."""
    h, h_error = h.copy(), h_error.copy()
    h[held], h_error[held] = 0.0, 0.0
    v = room.solved(h, held)
    Zv, error = room.Z.times(v), room.Z.rounding_of_product(v)
    rest = h - Zv
    rest[held], error[held] = 0.0, 0.0
    taken = float((h + rest) @ v) + gamma(len(v) + 8) * float((np.abs(h) + np.abs(rest)) @ np.abs(v))
    taken += float(error @ np.abs(v))
    rho = np.abs(rest) * (1.0 + 4.0 * UNIT) + error
    square = max(taken, 0.0) + float((rho**2 / room.margin).sum())
    root = np.sqrt(square) + np.sqrt(float((h_error**2 / room.margin).sum()))
    return float(root) * (1.0 + 1e-9)
