"""The translation of AX = XB for a rotation that is known: linear least squares over pairs, in linear time."""

from __future__ import annotations

import numpy as np

from gtsam_rwhec.compat.stations import Stations, all_earlier
from gtsam_rwhec.geometry.poses import Array


def translation_features(stations: Stations) -> Array:
    """Features (N, 46) of each station for the sums over the pairs that begin at it."""
    R_G, t_G, u, count = stations.R_G, stations.t_G, stations.u, len(stations.u)
    return np.concatenate(
        [
            np.ones((count, 1)),
            R_G.reshape(count, 9),
            t_G,
            u,
            np.einsum("nba,nb->na", R_G, t_G),
            np.einsum("nar,nb->narb", R_G, u).reshape(count, 27),
        ],
        axis=1,
    )


def translation_of(stations: Stations, R: Array, sums: Array | None = None) -> Array:
    """The t (3,) that minimises the sum of |(R_A - I) t - (R t_B - t_A)|^2 over pairs (Tsai & Lenz 1989, eq. 15).

    With p_j = R t_C,j + R_G,j' t_G,j and Z_j = R_G,j R R_C,j the right-hand side of a pair is
    e = p_j - R R_C,j u_i - R_G,j' t_G,i, and R_A' e = R_G,i' (R_G,j p_j - Z_j u_i - t_G,i): all bilinear in i and j.
    ``sums`` (N, 46) are the ``translation_features`` summed over the earlier stations of each station's pairs; all
    earlier stations by default.
    """
    R_G = stations.R_G
    R_RC = R @ stations.R_C
    p = stations.t_C @ R.T + np.einsum("nba,nb->na", R_G, stations.t_G)
    if sums is None:
        sums = all_earlier(translation_features(stations))
    ones, sum_R, sum_t = sums[:, 0], sums[:, 1:10].reshape(-1, 3, 3), sums[:, 10:13]
    sum_u, sum_Rt, sum_Ru = sums[:, 13:16], sums[:, 16:19], sums[:, 19:].reshape(-1, 3, 3, 3)
    sum_R_A = np.einsum("nab,nac->bc", R_G, sum_R)
    normal = 2.0 * ones.sum() * np.eye(3) - sum_R_A - sum_R_A.T  # (R_A - I)'(R_A - I) = 2 I - R_A - R_A'
    sum_e = ones @ p - np.einsum("nab,nb->a", R_RC, sum_u) - np.einsum("nba,nb->a", R_G, sum_t)
    turned = np.einsum("nar,nab,nb->r", sum_R, R_G, p, optimize=True)
    turned -= np.einsum("narb,nab->r", sum_Ru, R_G @ R_RC) + sum_Rt.sum(axis=0)
    return np.linalg.solve(normal, turned - sum_e)
