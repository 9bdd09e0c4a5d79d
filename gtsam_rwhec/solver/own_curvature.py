"""The curvature of Z along the rotation of one frame with all others held, for all frames at once."""

from __future__ import annotations

import numpy as np

from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.solver.part_form import PartForm
from gtsam_rwhec.solver.rotations import CONSTRAINTS_FLAT

#: What is added to the own translation's and scale's diagonal, as a part of it, where they are free.
FREE = 1e-9


def own_curvature(whole: PartForm, multipliers: Array) -> Array:
    """The smallest mu (n,) with Z v = mu Q v for vectors v of one frame alone: Z is surely negative where mu is."""
    own, inner = _own_blocks(whole)
    M = own[:, 4:, 4:] - np.matmul(own[:, 4:, :4], np.linalg.solve(inner, own[:, :4, 4:]))
    Lambda = (multipliers @ CONSTRAINTS_FLAT).reshape(-1, 10, 10)[:, :9, :9]
    values, vectors = np.linalg.eigh(0.5 * (M + M.transpose(0, 2, 1)))
    root = vectors / np.sqrt(np.maximum(values, 1e-9 * np.abs(values).max(axis=1, initial=1e-290)[:, None]))[:, None, :]
    smallest: Array = 1.0 - np.linalg.eigvalsh(root.transpose(0, 2, 1) @ Lambda @ root)[:, -1]
    return smallest


def _own_blocks(whole: PartForm) -> tuple[Array, Array]:
    """Each frame's own block of Q (n, 13, 13), and its part of translation and scale (n, 4, 4), made invertible."""
    own = whole.full.frames
    inner = own[:, :4, :4].copy()
    diagonal = np.einsum("nii->ni", inner)
    diagonal[...] = (1.0 + FREE) * diagonal + np.where(diagonal == 0.0, 1.0, 0.0)
    return own, inner
