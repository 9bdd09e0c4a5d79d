"""Daniilidis 1999 over all pairs of stations, and the dual quaternions of these pairs."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from gtsam_rwhec.compat.stations import Stations, pair_blocks, products
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.geometry.quaternions import conjugate, dual_parts, left, of_rotations
from gtsam_rwhec.handeye.daniilidis import squared, unit_combination
from gtsam_rwhec.handeye.dual_quaternions import to_transform


def daniilidis(stations: Stations) -> tuple[Array, Array]:
    """The two smallest right singular vectors of T (his eq. 31), combined so that |q| = 1 and q.q' = 0 (eqs. 33-35)."""
    gram = np.zeros((12, 12))
    for a, b, dual_a, dual_b, weight in screws(stations):
        z = np.concatenate([a[:3] + b[:3], a[:3] - b[:3], dual_a[:3] + dual_b[:3], dual_a[:3] - dual_b[:3]])
        gram += (z * weight).reshape(12, -1) @ z.reshape(12, -1).T
    basis = np.linalg.eigh(squared(gram))[1][:, :2]
    X = to_transform(*unit_combination(basis[:4], basis[4:]))
    return X[:3, :3], X[:3, 3]


def screws(stations: Stations) -> Iterator[tuple[Array, Array, Array, Array, Array]]:
    """Dual quaternions of A and B of all pairs, block by block: q_A, q_B, q'_A, q'_B (4, J, I) and weights (J, I)."""
    q_G, q_C = of_rotations(stations.R_G), of_rotations(stations.R_C)
    d_G, d_C = dual_parts(q_G, stations.t_G), dual_parts(q_C, stations.t_C)
    # Q_G,j* (x) Q_G,i and Q_C,j (x) Q_C,i*: the dual part of a product is q p' + q' p, here one product of 8 columns.
    left_G = np.concatenate([left(conjugate(q_G)), left(conjugate(d_G))], axis=2)
    right_G = np.concatenate([d_G, q_G], axis=1).T
    left_C = np.concatenate([left(q_C), left(d_C)], axis=2)
    right_C = np.concatenate([conjugate(d_C), conjugate(q_C)], axis=1).T
    for block in pair_blocks(stations):
        j, i = slice(block.first, block.last), slice(block.last)
        dual_a = products(left_G[j], right_G[:, i]) * block.signs[0]
        dual_b = products(left_C[j], right_C[:, i]) * block.signs[1]
        yield block.a, block.b, dual_a, dual_b, block.weight
