"""Daniilidis 1999: the null space of the dual quaternions' vector parts, over all pairs of stations."""

from __future__ import annotations

import numpy as np

from gtsam_rwhec.compat.quaternion_methods import rotation_of
from gtsam_rwhec.compat.stations import CONJUGATION, Stations, left_matrices, pair_blocks, products, quaternions
from gtsam_rwhec.errors import UnderdeterminedError
from gtsam_rwhec.poses import Array


def daniilidis(stations: Stations) -> tuple[Array, Array]:
    """The two smallest right singular vectors of T (his eq. 31), combined so that |q| = 1 and q.q' = 0 (eqs. 33-35)."""
    z = moments_of_screws(stations)
    E = screw_rows()
    normal = np.einsum("kl,kra,lrb->ab", z, E, E, optimize=True)  # T'T
    basis = np.linalg.eigh(normal)[1][:, :2]  # columns of 8: (q, q'), xyzw
    q, dual = unit_combination(basis[:4], basis[4:])
    t = 2.0 * (left_matrices(dual[None])[0] @ (q * CONJUGATION))[:3]
    return rotation_of(q), t


def unit_combination(u: Array, v: Array) -> tuple[Array, Array]:
    """The combination of two null vectors (columns of u over those of v, (4, 2) each) that is a unit dual quaternion.

    With angles in place of the ratio of the two coefficients neither of them has to differ from zero. Of the two
    solutions the one with the longer q is taken; the other one's q vanishes without noise.

    Raises
    ------
    UnderdeterminedError
        When the two vectors have no rotation in them.
    """
    form = u.T @ v
    form = 0.5 * (form + form.T)
    a, b, c = form[0, 0], 2.0 * form[0, 1], form[1, 1]
    half_difference, mean = np.hypot(b, a - c), a + c
    middle = np.arctan2(b, a - c)  # a cos^2 + b cos sin + c sin^2 = (mean + half_difference cos(2 phi - middle)) / 2
    spread = np.arccos(np.clip(-mean / half_difference, -1.0, 1.0)) if half_difference > 0.0 else 0.0
    phi = 0.5 * np.array([middle + spread, middle - spread])
    candidates = np.stack([np.cos(phi), np.sin(phi)])
    lengths = np.linalg.norm(u @ candidates, axis=0)
    best = int(lengths.argmax())
    if lengths[best] <= 1e-12:
        raise UnderdeterminedError(
            "the dual quaternions of the motions have a null space without rotations in it; add poses that turn about "
            "two different axes"
        )
    x = candidates[:, best] / lengths[best]
    return u @ x, v @ x


def screw_rows() -> Array:
    """E (12, 6, 8) with T's six rows of a pair = sum_k z_k E_k, z = (a, b, a', b') vector parts of A and B.

    The unknown is (q, q') with the scalar last in each, so a row block is [Skew(a + b), a - b].
    """
    E = np.zeros((12, 6, 8))
    for axis in range(3):
        unit = np.zeros(3)
        unit[axis] = 1.0
        skew = np.cross(np.eye(3), unit)  # rows e_k x unit: Skew(unit)'s entries with the sign below
        for sign, primal, dual in ((1.0, axis, 6 + axis), (-1.0, 3 + axis, 9 + axis)):
            E[primal, :3, :3] = skew
            E[primal, :3, 3] = sign * unit
            E[primal, 3:, 4:7] = skew
            E[primal, 3:, 7] = sign * unit
            E[dual, 3:, :3] = skew
            E[dual, 3:, 3] = sign * unit
    return E


def moments_of_screws(stations: Stations) -> Array:
    """Sum over pairs of z z' (12, 12), z the vector parts of the pair's dual quaternions with like signs."""
    q_G, q_C = quaternions(stations.R_G), quaternions(stations.R_C)
    d_G, d_C = dual_parts(q_G, stations.t_G), dual_parts(q_C, stations.t_C)
    # Q_G,j* (x) Q_G,i and Q_C,j (x) Q_C,i*: the dual part of a product is q p' + q' p, here one product of 8 columns.
    left_G = np.concatenate([left_matrices(q_G * CONJUGATION), left_matrices(d_G * CONJUGATION)], axis=2)
    right_G = np.concatenate([d_G, q_G], axis=1).T
    left_C = np.concatenate([left_matrices(q_C), left_matrices(d_C)], axis=2)
    right_C = np.concatenate([d_C * CONJUGATION, q_C * CONJUGATION], axis=1).T
    total = np.zeros((12, 12))
    for block in pair_blocks(stations):
        j, i = slice(block.first, block.last), slice(block.last)
        z = np.concatenate(
            [
                block.a[:3],
                block.b[:3],
                products(left_G[j], right_G[:, i])[:3] * block.signs[0],
                products(left_C[j], right_C[:, i])[:3] * block.signs[1],
            ]
        )
        total += (z * block.weight).reshape(12, -1) @ z.reshape(12, -1).T
    return total


def dual_parts(q: Array, t: Array) -> Array:
    """Dual parts 1/2 (t, 0) (x) q of poses (DQ paper, eq. 2), (N, 4)."""
    pure = np.concatenate([t, np.zeros((len(t), 1))], axis=1)
    d: Array = 0.5 * np.einsum("nab,nb->na", left_matrices(pure), q)
    return d
