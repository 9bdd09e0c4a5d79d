"""Errors that all corners of an image share, eliminated from sums of rows.

An image's rows have, besides its corners' own noise, P c with the patterns P (`corner_patterns`) and c ~ N(0, t^2 I).
With K = (I / t^2 + P'P / s^2)^-1 the sums of rows R lose R'P K P'R / s^2, and the variance's logarithm of the
determinant gains log |I + t^2 P'P / s^2|.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gtsam_rwhec.geometry.poses import Array


@dataclass(frozen=True, eq=False)
class CommonErrors:
    """Products of each image's patterns P with its rows: by the unknowns (V, k, d), A, the residual, and themselves."""

    instant: np.ndarray
    of_unknowns: Array
    of_A: Array
    of_residual: Array
    P: Array

    def first(self, number: int) -> CommonErrors:
        """Those of the first patterns."""
        of_unknowns, of_A, of_residual = (each[:, :number] for each in (self.of_unknowns, self.of_A, self.of_residual))
        return CommonErrors(self.instant, of_unknowns, of_A, of_residual, self.P[:, :number, :number])

    def inverse(self, common_px: float, s2: float) -> tuple[Array, float]:
        """K (V, k, k), and the gain of the logarithm of the determinant."""
        inner = np.eye(self.P.shape[1]) + self.P * (common_px**2 / s2)
        return np.linalg.inv(inner) * common_px**2, float(np.linalg.slogdet(inner)[1].sum())

    def twice_by_log(self, common_px: float, s2: float, theta: Array, covariance: Array, carriers: Carriers) -> float:
        """The derivative of -2 log L by log t: twice their number less their squares, as estimated and as uncertain.

        ``theta`` (d,) with its covariance (d, d).
        """
        K, _ = self.inverse(common_px, s2)
        E, D, e = K @ self.of_unknowns / s2, K @ self.of_A / s2, (K @ self.of_residual[..., None])[..., 0] / s2
        at = self.instant
        c = -(e + E @ theta + (D @ carriers.a[at][..., None])[..., 0])
        E = E - D @ carriers.KC[at]
        variance = np.diagonal(K, axis1=1, axis2=2) + ((D @ carriers.K[at]) * D).sum(axis=2)
        variance = variance + ((E @ covariance) * E).sum(axis=2)
        return 2.0 * float(c.size - (c**2 + variance).sum() / common_px**2)


@dataclass(frozen=True, eq=False)
class Carriers:
    """The carriers' errors a (I, 6) as they are estimated, a = -K b - KC theta, with K (I, 6, 6) and KC (I, 6, d)."""

    a: Array
    K: Array
    KC: Array


def whitened(rows: Array, P: Array) -> Array:
    """Rows (V, 2n, m) of unit noise and the common errors P c, c ~ N(0, I): (I + P P')^(-1/2) of them.

    With P = U S V', that is I - U (1 - (1 + S^2)^(-1/2)) U'.
    """
    U, S, _ = np.linalg.svd(P, full_matrices=False)
    lost = 1.0 - 1.0 / np.sqrt(1.0 + S**2)
    result: Array = rows - (U * lost[:, None]) @ (U.transpose(0, 2, 1) @ rows)
    return result
