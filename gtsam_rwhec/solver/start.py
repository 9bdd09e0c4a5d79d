"""Starting points of descents: the spectral solution of the rotation residuals, and the unconstrained one of Q'."""

from __future__ import annotations

import numpy as np
import scipy.linalg

from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.solver import arrow
from gtsam_rwhec.solver.descent import SearchForm
from gtsam_rwhec.solver.full_form import FullForm
from gtsam_rwhec.solver.graph_form import GraphForm
from gtsam_rwhec.solver.graph_start import graph_unconstrained_start
from gtsam_rwhec.solver.parts import Part, connected_components
from gtsam_rwhec.solver.rotations import project, unvec, vec


def spectral_start(part: Part, rotation_form: FullForm) -> list[Array]:
    """Rotations that minimise the rotation residuals over all matrices, projected to SO(3); (n, 3, 3) each.

    With exact data the minimisers are a line through the truth (Corollary 2), so the smallest eigenvector is the truth
    up to its sign. Leaves are eliminated first, so the eigenvalue problem is about the centers only. Known frames and
    priors add terms with h; then both signs are returned, and the cost decides.
    """
    L, P = rotation_form.leaves, rotation_form.centers
    D = rotation_form.leaf
    if P == 0:  # every center is a fixed frame: each leaf has its own linear problem
        return [project(unvec(-np.linalg.solve(D, rotation_form.leaf_tail[:, :, 1, None])))]
    C = np.empty((L, 9, 9 * P + 1))
    C[:, :, :-1] = rotation_form.leaf_center.transpose(0, 2, 1, 3).reshape(L, 9, 9 * P)
    C[:, :, -1] = rotation_form.leaf_tail[:, :, 1]
    E = np.zeros((9 * P + 1, 9 * P + 1))
    np.einsum("papb->pab", E[:-1, :-1].reshape(P, 9, P, 9))[...] = rotation_form.center
    E[-1, -1] = rotation_form.tail[1, 1]
    E[:-1, -1] = E[-1, :-1] = rotation_form.center_tail[:, :, 1].ravel()
    to_border = np.linalg.solve(D, C)
    S = E - arrow.flat(C).T @ arrow.flat(to_border)
    S = 0.5 * (S + S.T)

    anchored = bool(np.abs(E[-1, :-1]).max(initial=0.0) > 0.0 or np.abs(C[:, :, -1]).max(initial=0.0) > 0.0)
    border = np.zeros(9 * P + 1)
    if anchored:
        border[:] = _smallest_eigenvector(S)
    else:
        # Components that only the shared scale joins each have an eigenvector and a sign.
        for block in _center_blocks(part):
            at = (9 * block[:, None] + np.arange(9)).ravel()
            r = _smallest_eigenvector(S[at[:, None], at])
            border[at] = r * _handedness(r)
    starts = []
    for sign in (1.0, -1.0) if anchored else (1.0,):
        centers = project(unvec(sign * border[:-1]))
        known = np.append(vec(centers), 1.0 if anchored else 0.0)
        leaves = project(unvec(-(to_border @ known))) if L else np.empty((0, 3, 3))
        starts.append(np.concatenate([leaves, centers]))
    return starts


def _smallest_eigenvector(S: Array) -> Array:
    """The smallest eigenvector of a symmetric matrix. For a small one, all eigenvectors take less time."""
    if len(S) <= 64:
        return np.linalg.eigh(S)[1][:, 0]
    vectors: Array = scipy.linalg.eigh(S, subset_by_index=[0, 0], check_finite=False)[1]
    return vectors[:, 0]


def _handedness(r: Array) -> float:
    """+1 or -1, so that the blocks of r are right-handed (design fact 5)."""
    determinants = np.linalg.det(unvec(r))
    return 1.0 if determinants.sum() >= 0.0 else -1.0


def _center_blocks(part: Part) -> list[np.ndarray]:
    index = {name: i for i, name in enumerate(part.centers)}
    blocks = [[index[name] for name in names if name in index] for names in connected_components(part.pairs)]
    return [np.array(block) for block in blocks if block]


def unconstrained_start(form: SearchForm) -> list[Array]:
    """Minimisers of x'Q'x over all matrices. Where Q' has linear terms, h = 1; else it is the smallest eigenvector.

    Q' has the translation residuals too, so these starts can be better where rotations alone are poorly excited. The
    eigenvector comes from inverse iteration on the arrow factor.
    """
    if isinstance(form, GraphForm):
        return graph_unconstrained_start(form)
    C, E = form.C[:, :, :-1], form.E[:-1, :-1]
    shift = 1e-12 * form.magnitude
    border, square = arrow.with_low_rank(C, E + shift * np.eye(len(E)), form.G_leaf, form.G_border[:, :-1])
    factor = arrow.cholesky(form.D + shift * np.eye(9), border, square)
    if factor is None:
        return []

    def solved(right: Array) -> Array:
        return factor.solve_vector(np.r_[right, np.zeros(len(form.G))])[: len(right)]

    last = np.zeros(form.size)
    last[-1] = 1.0
    linear = form.apply(last)[:-1]
    candidates = []
    if np.abs(linear).max(initial=0.0) > 0.0:
        candidates.append(solved(-linear))
    v: Array = np.ones(form.size - 1)
    for _ in range(8):
        v = solved(v)
        v /= np.linalg.norm(v)
    candidates.append(v * _handedness(v))
    return [project(unvec(r)) for r in candidates]
