"""Successive estimates of the same numbers, which nights may lack in part: what a control chart is made from."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import solve_triangular

from gtsam_rwhec.geometry.poses import Array

#: Nights between which a change is sought; earlier ones are one estimate together.
MOST_NIGHTS = 60


@dataclass(frozen=True, eq=False)
class Nights:
    """Successive estimates of the same numbers, in units in which all are of similar size.

    Attributes
    ----------
    days : (n,) array
        When, days.
    x : (n, m) array
        Zero in rows that a night does not determine.
    information : (n, m, m) array
        Zero in these rows and columns.
    root : (n, m, m) array
        R with R' R the information.
    groups : dict of str to slice
        The rows of each frame.
    earlier : int
        Nights that are in the first one together.
    squares, dimensions : float, int
        The residual squares of these, and their number.
    """

    days: Array
    x: Array
    information: Array
    root: Array
    groups: Mapping[str, slice]
    earlier: int = 0
    squares: float = 0.0
    dimensions: int = 0

    @staticmethod
    def none(groups: Mapping[str, slice]) -> Nights:
        """No nights yet."""
        m = max((rows.stop for rows in groups.values()), default=0)
        return Nights(np.zeros(0), np.zeros((0, m)), np.zeros((0, m, m)), np.zeros((0, m, m)), groups)

    def __len__(self) -> int:
        return len(self.days)

    @property
    def count(self) -> int:
        """How many nights there are, with those that are one together."""
        return len(self) + max(self.earlier - 1, 0)

    @property
    def seen(self) -> np.ndarray:
        """(n, m): what each night determines."""
        seen: np.ndarray = np.einsum("nii->ni", self.information) > 0.0
        return seen

    def with_night(self, day: float, x: Array, information: Array) -> Nights:
        """The nights and one more; beyond ``MOST_NIGHTS`` the two oldest become one."""
        L = information[None]
        more = replace(
            self,
            days=np.append(self.days, day),
            x=np.concatenate([self.x, x[None]]),
            information=np.concatenate([self.information, L]),
            root=np.concatenate([self.root, _root(information, self.information[:1])[None]]),
        )
        return more if len(more) <= MOST_NIGHTS else more._with_oldest_joined()

    def after(self, night: int) -> Nights:
        """The nights from index ``night`` on."""
        return Nights(self.days[night:], self.x[night:], self.information[night:], self.root[night:], self.groups)

    def until(self, night: int) -> Nights:
        """The nights before index ``night``."""
        return replace(
            self, days=self.days[:night], x=self.x[:night], information=self.information[:night], root=self.root[:night]
        )

    def _with_oldest_joined(self) -> Nights:
        L = self.information[:2].sum(axis=0)
        seen = np.diagonal(L) > 0.0
        mean = np.where(seen, solved(L, np.einsum("nij,nj->i", self.information[:2], self.x[:2]), seen), 0.0)
        r = self.x[:2] - mean
        return replace(
            self,
            days=self.days[1:],
            x=np.concatenate([mean[None], self.x[2:]]),
            information=np.concatenate([L[None], self.information[2:]]),
            root=self.root[1:],
            earlier=max(self.earlier, 1) + 1,
            squares=self.squares + float(np.einsum("ni,nij,nj->", r, self.information[:2], r)),
            dimensions=self.dimensions + int(self.seen[:2].sum()) - int(seen.sum()),
        )


def solved(S: Array, u: Array, seen: np.ndarray) -> Array:
    """S^-1 u over the rows that are seen, 0 in the others; stacks of them too."""
    S = np.where(seen[..., :, None] & seen[..., None, :], S, 0.0)
    S = S + np.where(seen, 0.0, 1.0)[..., :, None] * np.eye(S.shape[-1])
    found: Array = np.linalg.solve(S, np.where(seen, u, 0.0)[..., None])[..., 0]
    return found


def _root(information: Array, first: Array) -> Array:
    """R with R' R the information: symmetric in the numbers that the first night whitens. No axes are special."""
    whitens = first[0] if len(first) else information
    W = np.linalg.cholesky(whitens + np.diag(np.where(np.diagonal(whitens) > 0.0, 0.0, 1.0))).T
    inward = solve_triangular(W, information, trans="T")
    values, vectors = np.linalg.eigh(solve_triangular(W, inward.T, trans="T"))
    root: Array = (vectors * np.sqrt(np.maximum(values, 0.0))) @ vectors.T @ W
    return root
