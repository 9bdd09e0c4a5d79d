"""Andreff, Horaud & Espiau 1999: vec(R) and t at once, by linear least squares over all pairs, in linear time."""

from __future__ import annotations

import numpy as np

from gtsam_rwhec.compat.stations import Stations, all_earlier
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.methods.normal_equations import solve_scaled
from gtsam_rwhec.solver.rotations import project

#: An eigenvalue below this of the scaled normal equations is rounding error.
SINGULAR = 1e-15
#: A user reads this when the poses leave entries of the rotation free.
LENGTH_UNKNOWN = (
    "{} linear system finds the rotation's length from the translations, and these do not determine it: the gripper "
    "only turned, or hardly moved; move the gripper, or use another method"
)


def andreff(stations: Stations) -> tuple[Array, Array]:
    """Least squares of (I - R_A (x) R_B) vec(R) = 0 and (I (x) t_B') vec(R) + (I - R_A) t = t_A (their eq. 11).

    vec takes rows. R is the nearest rotation. As in OpenCV 4, t stays the linear system's. The 12 x 12 normal equations
    are sums over pairs of products of the two stations' features: with D_j = R_G,j' (x) R_C,j the product R_A (x) R_B
    is D_j D_i'. Raises UnderdeterminedError when the translations do not determine the rotation's length.
    """
    R_G, t_G, R_C, u, count = stations.R_G, stations.t_G, stations.R_C, stations.u, len(stations.u)
    t_C = stations.t_C
    D = np.einsum("nba,ncd->nacbd", R_G, R_C).reshape(count, 9, 9)
    features = np.concatenate(
        [
            np.ones((count, 1)),
            u,
            t_G,
            np.einsum("nba,nb->na", R_G, t_G),
            R_G.reshape(count, 9),
            np.einsum("na,nb->nab", u, u).reshape(count, 9),
            np.einsum("na,nb->nab", u, t_G).reshape(count, 9),
            np.einsum("nd,nac->ndac", u, R_G).reshape(count, 27),
            D.transpose(0, 2, 1).reshape(count, 81),
        ],
        axis=1,
    )
    ends = np.cumsum([1, 3, 3, 3, 9, 9, 9, 27])
    ones, U, T, RT, G, UU, UT, UG, DD = np.split(all_earlier(features), ends, axis=1)
    G, UU, UT = (part.reshape(-1, 3, 3) for part in (G, UU, UT))
    UG, DD = UG.reshape(-1, 3, 3, 3), DD.reshape(-1, 9, 9)
    pairs = ones.sum()

    sum_K = np.einsum("nab,nbc->ac", D, DD, optimize=True)
    sum_R_A = np.einsum("nab,nac->bc", R_G, G)
    # t_B = t_C,j - R_C,j u_i and t_A = R_G,j' (t_G,i - t_G,j)
    cu = np.einsum("nab,nb->na", R_C, U)
    crossed = np.einsum("na,nb->ab", t_C, cu)
    tB_tB = np.einsum("n,na,nb->ab", ones[:, 0], t_C, t_C) - crossed - crossed.T
    tB_tB += np.einsum("nab,nbc,ndc->ad", R_C, UU, R_C, optimize=True)
    away = np.einsum("nab,na->nb", R_G, t_G)  # R_G,j' t_G,j
    tB_tA = np.einsum("nb,nar,na->br", t_C, R_G, T, optimize=True)
    tB_tA -= np.einsum("n,nb,nr->br", ones[:, 0], t_C, away)
    tB_tA -= np.einsum("nbd,nda,nar->br", R_C, UT, R_G, optimize=True) - cu.T @ away
    sum_tB = ones[:, 0] @ t_C - cu.sum(axis=0)
    tB_RA = np.einsum("nb,nar,nac->brc", t_C, R_G, G, optimize=True)
    tB_RA -= np.einsum("nbd,nar,ndac->brc", R_C, R_G, UG, optimize=True)
    RA_tA = RT.sum(axis=0) - np.einsum("nac,na->c", G, t_G)
    sum_tA = np.einsum("nar,na->r", R_G, T) - ones[:, 0] @ away

    normal = np.empty((12, 12))
    normal[:9, :9] = 2.0 * pairs * np.eye(9) - sum_K - sum_K.T + np.kron(np.eye(3), tB_tB)
    coupling = np.einsum("b,rc->rbc", sum_tB, np.eye(3)) - tB_RA.transpose(1, 0, 2)
    normal[:9, 9:] = coupling.reshape(9, 3)
    normal[9:, :9] = normal[:9, 9:].T
    normal[9:, 9:] = 2.0 * pairs * np.eye(3) - sum_R_A - sum_R_A.T
    right = np.concatenate([tB_tA.T.reshape(9), sum_tA - RA_tA])
    x = solve_scaled(normal, right, LENGTH_UNKNOWN.format("Andreff's"), SINGULAR)
    return project(x[:9].reshape(1, 3, 3))[0], x[9:]
