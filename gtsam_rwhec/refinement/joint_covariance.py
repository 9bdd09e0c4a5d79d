"""From an information matrix with free directions to covariances that are infinite along them.

With F the free directions (``FreeSpace``), a prior of variance tau along them has, for tau to infinity, the covariance

    tau F F' + Q (Q' Lambda Q)^-1 Q'          (Q spans F's orthogonal complement)

so that whatever F does not touch has a finite covariance, and everything else an infinite one. GTSAM's Marginals throw
there, or return 1e18.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from rwhec_factors import se3
from scipy.linalg import block_diag

from gtsam_rwhec.errors import FrameError
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.refinement.unknowns import Unknown, rows_of, slots_of

#: A linear function whose share along the free directions is below this is called determined (the share below which a
#: free direction's sentence leaves a frame out).
SHARE = 0.05
#: How far along a free direction an estimate is taken to be from the truth, in units (the typical length).
DISPLACED = 1.0
#: Below this, of the largest, an equilibrated information's eigenvalue is rounding.
ROUNDING = 1e-13


@dataclass(frozen=True)
class JointCovariance:
    """Of all unknowns together: dense, d x d.

    Attributes
    ----------
    slots : dict of Unknown to slice
        Rows of each.
    finite : (d, d) array
        Q (Q' Lambda Q)^-1 Q'.
    free : (d, k) array
        Directions of infinite variance, orthonormal in units of ``unit``.
    unit : (d,) array
        What counts as one: 1 rad, the typical length, ...
    """

    slots: dict[Unknown, slice]
    finite: Array
    free: Array
    unit: Array

    @staticmethod
    def of(unknowns: tuple[Unknown, ...], information: Array, free: Array, unit: Array) -> JointCovariance:
        """Invert.

        Parameters
        ----------
        unknowns : tuple of Unknown
            What the rows are of, in order.
        information : (d, d) array
        free : (d, k) array
            Directions that the measurements leave free, in the parameters' own units; k may be 0.
        unit : (d,) array
        """
        scaled = information * unit[:, None] * unit
        scaled = 0.5 * (scaled + scaled.T)
        basis = _orthonormal(free / unit[:, None])
        Q = np.linalg.svd(basis, full_matrices=True)[0][:, basis.shape[1] :] if basis.shape[1] else np.eye(len(unit))
        inside = Q.T @ scaled @ Q
        # Equilibrated, so that rounding is judged by each parameter's own information.
        size = np.sqrt(np.maximum(np.diagonal(inside), 1e-300))
        values, vectors = np.linalg.eigh(inside / size[:, None] / size)
        lost = values <= ROUNDING * values.max(initial=0.0)
        if lost.any():  # no measurement speaks of these at all
            more = Q @ (vectors[:, lost] / size[:, None])
            return JointCovariance.of(unknowns, information, np.hstack([free, more * unit[:, None]]), unit)
        root = Q @ (vectors / np.sqrt(values) / size[:, None])
        finite = (root @ root.T) * np.outer(unit, unit)
        return JointCovariance(slots_of(unknowns), finite, basis, unit)

    def rows(self, unknowns: tuple[Unknown, ...]) -> np.ndarray:
        """Indices of some unknowns, in the order given.

        Raises
        ------
        FrameError
            For what is not among the unknowns.
        """
        for unknown in unknowns:
            if unknown not in self.slots:
                there = ", ".join(map(str, self.slots))
                raise FrameError(f"there is no {str(unknown)!r} among the unknowns; there are {there}")
        return rows_of(self.slots, unknowns)

    def selector(self, unknowns: tuple[Unknown, ...]) -> Array:
        """(m, d): picks their rows."""
        selected: Array = np.eye(len(self.unit))[self.rows(unknowns)]
        return selected

    def reach(self, G: Array) -> Array:
        """(m, k): how far the rows of G move when the free directions are gone along until the parameter that moves
        most has moved by one unit."""
        if self.free.shape[1] == 0:
            return np.zeros((len(G), 0))
        # Many frames that move together share one direction's length.
        largest = np.linalg.norm(self.free, axis=1).max()
        moved: Array = (G * self.unit) @ self.free / largest
        return moved

    def covariance_of(self, G: Array) -> Array:
        """(m, m) covariance of the linear functions G (m, d) of the unknowns.

        Infinite in every row that a free direction reaches, and between two such rows of one direction (with the sign
        of their correlation). A row that it reaches by next to nothing (``SHARE``) has the variance that going along
        it by ``DISPLACED`` units makes: an estimate is somewhere on the free direction, not anywhere.
        """
        moved = self.reach(G)
        length = np.linalg.norm(G * self.unit, axis=1)
        shares = moved / np.where(length > 0.0, length, 1.0)[:, None]
        touched = np.linalg.norm(shares, axis=1) > SHARE
        covariance: Array = G @ self.finite @ G.T + DISPLACED**2 * moved @ moved.T
        along = shares @ shares.T
        reached = touched[:, None] & touched & (np.abs(along) > SHARE**2 * 1e-3)
        covariance[reached] = np.inf * np.sign(along[reached])
        return covariance

    def information_of(self, unknowns: tuple[Unknown, ...]) -> Array:
        """(m, m) marginal information: the inverse of the covariance where it is finite, 0 along free directions."""
        chosen = self.selector(unknowns)
        unit = self.unit[self.rows(unknowns)]
        moved = self.reach(chosen) / unit[:, None]
        # Directions among these that a free one reaches, strongest first; the rest of them counts as displaced.
        U, s, _ = np.linalg.svd(moved, full_matrices=True)
        rank = int((s > SHARE).sum())
        turned = block_diag(*(self.turned(unknown) for unknown in unknowns))
        finite = (chosen @ self.finite @ chosen.T + turned) / unit[:, None] / unit
        finite += DISPLACED**2 * moved @ moved.T
        Q = U[:, rank:]
        inside: Array = Q @ np.linalg.inv(Q.T @ finite @ Q) @ Q.T
        marginal: Array = inside / unit[:, None] / unit
        return marginal

    def turned(self, unknown: Unknown) -> Array:
        """(m, m): what a rotation's error does to a frame that is displaced along a free direction.

        The direction is known as well as the rotation is: displaced by f, an error omega moves the frame across it by
        omega x f. Second order, but f is no small perturbation.
        """
        rows = self.rows((unknown,))
        result = np.zeros((len(rows), len(rows)))
        if len(rows) == 6:
            for f in DISPLACED * self.reach(self.selector((unknown,)))[3:].T:
                across = se3.hat(f)
                result[3:, 3:] += across @ self.finite[np.ix_(rows[:3], rows[:3])] @ across.T
        return result


def _orthonormal(basis: Array) -> Array:
    """An orthonormal basis of the columns' span."""
    if basis.shape[1] == 0:
        return basis
    U, s, _ = np.linalg.svd(basis / np.maximum(np.linalg.norm(basis, axis=0), 1e-300), full_matrices=False)
    span: Array = U[:, s > 1e-9 * max(s[0], 1e-300)]
    return span
