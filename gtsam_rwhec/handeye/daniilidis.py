"""Dan: Daniilidis, Hand-Eye Calibration Using Dual Quaternions (IJRR 1999), the linear method of the DQ paper's [9].

A conjugation keeps the scalar parts, so eq. 7 is taken without them. Each motion gives six rows, linear in the eight
unknowns (q, q'),

    [ P   0 ]           P = [Skew(v_C + v_H), v_C - v_H]   (3 x 4, unknowns with the scalar last),
    [ P'  P ]           P' the same of the dual parts.

Without noise the null space has two dimensions and holds one unit dual quaternion. Nothing is minimised: the answer
combines the two right singular vectors of the smallest singular values so that |q| = 1 and q . q' = 0.
"""

from __future__ import annotations

import math

import numpy as np

from gtsam_rwhec.errors import UnderdeterminedError
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.handeye.cost import E, by_parts, gram
from gtsam_rwhec.handeye.degenerate import free_of_rotations_alone
from gtsam_rwhec.handeye.dual_quaternions import to_transform
from gtsam_rwhec.handeye.request import Request
from gtsam_rwhec.methods.estimate import Outcome

#: Squares of singular values below this part of the largest are rounding error.
NULL = 1e-13
#: These rows of ``Motions.rows`` hold vector parts.
_VECTORS = [0, 1, 2, 3, 4, 5, 7, 8, 9, 10, 11, 12]
#: Row 6 k + l is vec(P_k' P_l): P is linear in the six numbers (v_C + v_H, v_C - v_H).
_PRODUCTS = np.einsum("kji,ljm->klim", E[:6, :3], E[:6, :3]).reshape(36, 16)


def daniilidis(request: Request) -> Outcome[Array]:
    """Dan, with translations multiplied by alpha as in Section 4.3.

    Raises UnderdeterminedError when all axes are parallel, or no motion rotates: the null space then has more than two
    dimensions.
    """
    moments = gram(request.motions.rows, request.weights)[np.ix_(_VECTORS, _VECTORS)]
    moments[6:] *= request.alpha
    moments[:, 6:] *= request.alpha
    values, vectors = np.linalg.eigh(squared(moments))
    if values[2] <= NULL * values[7]:
        raise UnderdeterminedError(
            "Daniilidis' equations have more than the two null vectors of a solvable problem: no motion rotates, or "
            "all motions rotate about parallel axes; add motions about another axis, or use method='dqopt', which "
            "solves what can be solved and names the free directions"
        )
    q, q_dual = unit_combination(vectors[:4, :2], vectors[4:, :2])
    free = free_of_rotations_alone(request)
    return Outcome(to_transform(q, q_dual / request.alpha), free_directions=free)


def squared(moments: Array) -> Array:
    """T'T (8, 8) from moments (12, 12) of (v_C + v_H, v_C - v_H) of the primal parts, then of the dual parts."""
    (PP, _), (DP, DD) = by_parts(moments, _PRODUCTS)
    return np.block([[PP + DD, DP], [DP.T, PP]])


def unit_combination(u: Array, v: Array) -> tuple[Array, Array]:
    """The unit dual quaternion among the combinations of two vectors: the columns of u (4, 2) over those of v (4, 2).

    Two combinations have q . q' = 0. The combination with the longer q is taken: without noise the other q vanishes.
    (The paper solves for the ratio s of the coefficients and must avoid a vector whose coefficient is 0. An angle
    avoids no vector.) Raises UnderdeterminedError when no combination has a rotation.
    """
    (a, b), (c, d) = (u.T @ v).tolist()
    # (x, y) = (cos phi, sin phi):  a x^2 + (b + c) x y + d y^2 = (a + d + (a - d) cos 2 phi + (b + c) sin 2 phi) / 2
    amplitude, middle = math.hypot(a - d, b + c), math.atan2(b + c, a - d)
    spread = math.acos(max(-1.0, min(1.0, -(a + d) / amplitude))) if amplitude > 0.0 else 0.0
    phi = 0.5 * np.array([middle + spread, middle - spread])
    candidates = np.stack([np.cos(phi), np.sin(phi)])
    lengths = np.linalg.norm(u @ candidates, axis=0)
    best = int(lengths.argmax())
    if lengths[best] <= 1e-12:
        raise UnderdeterminedError(
            "the null vectors of Daniilidis' equations hold no rotation; add motions about two different axes"
        )
    x = candidates[:, best] / lengths[best]
    return u @ x, v @ x
