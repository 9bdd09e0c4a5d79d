"""The inverse of a positive definite matrix of many frames, most pairs of which no measurement ties.

Targets that one camera sees are independent given the camera: their blocks are eliminated all at once, and so on with
what is left, until that is small or dense. The inverse itself is dense.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg.lapack import dpotri

from gtsam_rwhec.geometry.poses import Array

#: Smaller matrices are inverted as a whole.
SMALL = 120
#: Blocks are eliminated together where they are at least this share of what is left.
WORTH_IT = 0.3


@dataclass(frozen=True)
class EliminationOrder:
    """Which parameters are eliminated at once.

    Attributes
    ----------
    size : int
        The number of all parameters.
    levels : tuple of (n, w) arrays
        n blocks of w parameters which nothing ties to one another once the levels before are eliminated.
    """

    size: int
    levels: tuple[np.ndarray, ...] = ()

    @staticmethod
    def of(matrix: Array) -> EliminationOrder:
        """For matrices (d, d) that are zero where this one is; its parameters with the same ties are blocks."""
        size, levels = len(matrix), []
        if size > SMALL:
            tied = (matrix != 0.0) | np.eye(size, dtype=bool)
            _, first, member = np.unique(np.packbits(tied, axis=1), axis=0, return_index=True, return_inverse=True)
            neighbours = tied[np.ix_(first, first)]
            np.fill_diagonal(neighbours, val=False)
            widths = np.bincount(member.ravel())
            blocks = np.split(np.argsort(member.ravel(), kind="stable"), np.cumsum(widths)[:-1])
            left = np.ones(len(blocks), dtype=bool)
            while widths[left].sum() > SMALL:
                chosen = _independent(neighbours, widths, left)
                if len(chosen) < 2 or widths[chosen].sum() < WORTH_IT * widths[left].sum():
                    break
                levels.append(np.array([blocks[number] for number in chosen]))
                left[chosen] = False
                ties = neighbours[chosen].astype(np.float64)  # through these, their neighbours are tied
                neighbours |= ties.T @ ties > 0.0
                np.fill_diagonal(neighbours, val=False)
        return EliminationOrder(size, tuple(levels))

    def inverse(self, matrix: Array) -> tuple[Array, float]:
        """The inverse of a matrix of this pattern, and log|matrix|; LinAlgError if it is not positive definite."""
        return _inverse(matrix, self.levels, np.arange(self.size))


def _independent(neighbours: np.ndarray, widths: np.ndarray, left: np.ndarray) -> np.ndarray:
    """Blocks of one width that are no neighbours, those with few neighbours first."""
    best = np.zeros(0, dtype=np.int64)
    degree = (neighbours & left).sum(axis=1)
    for width in np.unique(widths[left]):
        found, is_free = [], left & (widths == width)
        for number in np.argsort(degree, kind="stable"):
            if is_free[number]:
                found.append(number)
                is_free &= ~neighbours[number]
        if len(found) * width > len(best) * (widths[best[0]] if len(best) else 1):
            best = np.array(found)
    return best


def _inverse(matrix: Array, levels: tuple[np.ndarray, ...], names: np.ndarray) -> tuple[Array, float]:
    """``names`` are the parameters of the rows, in order."""
    if not levels:
        L = np.linalg.cholesky(matrix)
        log_det = 2.0 * float(np.log(np.diagonal(L)).sum())
        if not len(L):
            return L, log_det
        lower = np.tril(dpotri(L, lower=1)[0])
        whole: Array = lower + np.tril(lower, -1).T
        return whole, log_det
    own = np.searchsorted(names, levels[0])
    is_rest = np.ones(len(matrix), dtype=bool)
    is_rest[own] = False
    rest, flat = np.flatnonzero(is_rest), own.ravel()
    blocks, ties = matrix[own[:, :, None], own[:, None]], matrix[flat[:, None], rest]
    log_det = 2.0 * float(np.log(np.diagonal(np.linalg.cholesky(blocks), axis1=1, axis2=2)).sum())
    alone = np.linalg.inv(blocks)
    through = (alone @ ties.reshape(*own.shape, -1)).reshape(len(flat), -1)
    of_rest, log_det_rest = _inverse(matrix[rest[:, None], rest] - ties.T @ through, levels[1:], names[rest])
    mixed = through @ of_rest
    result = np.empty_like(matrix)
    result[rest[:, None], rest] = of_rest
    result[flat[:, None], rest] = -mixed
    result[rest[:, None], flat] = -mixed.T
    result[flat[:, None], flat] = mixed @ through.T
    result[own[:, :, None], own[:, None]] += alone
    return result, log_det + log_det_rest
