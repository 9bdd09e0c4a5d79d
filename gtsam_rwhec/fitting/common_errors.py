"""Errors that all corners of an image share, eliminated from sums of rows.

An image's rows have, besides its corners' own noise, P c with the patterns P (`corner_patterns`) and c ~ N(0, t^2 I).
With K = (I / t^2 + P'P / s^2)^-1 the sums of rows R lose R'P K P'R / s^2, and the variance's logarithm of the
determinant gains log |I + t^2 P'P / s^2|.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from gtsam_rwhec.fitting.corner_residuals import Places, Stack
from gtsam_rwhec.fitting.joint_covariance import ArrowInverse
from gtsam_rwhec.geometry.poses import Array


@dataclass(frozen=True, eq=False)
class OfStack:
    """Products of the patterns P of a stack's V images with their rows.

    An image's rows have few of the unknowns: only ``columns`` (T, m) are stored, those of its target.
    """

    stack: Stack
    columns: np.ndarray
    places: Places
    of_unknowns: Array  #: (V, k, m)
    of_A: Array  #: (V, k, 6)
    of_residual: Array  #: (V, k)
    P: Array  #: (V, k, k), or its diagonal (V, k) where an image's patterns are orthogonal

    def orthogonal(self, number: int) -> OfStack:
        """The products of as many orthogonal patterns as the first ones span: turned, they are as independent."""
        values, turn = np.linalg.eigh(self.P[:, :number, :number])
        turn = turn.transpose(0, 2, 1)
        of_residual = (turn @ self.of_residual[:, :number, None])[..., 0]
        of_unknowns, of_A = turn @ self.of_unknowns[:, :number], turn @ self.of_A[:, :number]
        return replace(self, of_unknowns=of_unknowns, of_A=of_A, of_residual=of_residual, P=np.maximum(values, 0.0))


@dataclass(frozen=True, eq=False)
class CommonErrors:
    """The products of all stacks' images."""

    stacks: tuple[OfStack, ...]

    def orthogonal(self, number: int) -> CommonErrors:
        """Those of as many orthogonal patterns as the first ones span."""
        return CommonErrors(tuple(stack.orthogonal(number) for stack in self.stacks))

    def inverse(self, common_px: float, s2: float) -> tuple[list[Array], float]:
        """The diagonals (V, k, 1) of K of each stack's orthogonal patterns, and the gain of log of the determinant."""
        inner = [1.0 + stack.P * (common_px**2 / s2) for stack in self.stacks]
        return [(common_px**2 / each)[..., None] for each in inner], sum(float(np.log(each).sum()) for each in inner)

    def twice_by_log(self, common_px: float, s2: float, found: Array, inverse: ArrowInverse, of: Carriers) -> float:
        """The derivative of -2 log L by log t: twice their number less their squares, as estimated and as uncertain.

        ``found`` are the unknowns theta and the carriers' errors a, in deviations, with their covariance. An image's
        errors are c = -(e + E theta + D a).
        """
        squares, number = 0.0, 0
        of_a = inverse.at(of.places, of.places)
        for stack, K in zip(self.stacks, self.inverse(common_px, s2)[0], strict=True):
            at, own = stack.stack.instant, stack.columns
            E, D = K / s2 * stack.of_unknowns, K / s2 * (stack.of_A * of.deviations)
            e = K[..., 0] / s2 * stack.of_residual
            of_theta = (E @ stack.stack.each(found[own])[..., None])[..., 0]
            c = -(e + of_theta + (D @ found[of.places[at]][..., None])[..., 0])
            with_a = inverse.between(stack.stack.each(own), of.places[at])  # (V, m, 6)
            variance = K[..., 0] + ((D @ of_a[at]) * D).sum(axis=2)
            variance = variance + ((E @ stack.stack.each(inverse.at(own, own))) * E).sum(axis=2)
            variance = variance + 2.0 * ((E @ with_a) * D).sum(axis=2)
            squares += float((c**2 + variance).sum())
            number += c.size
        return 2.0 * (number - squares / common_px**2)


@dataclass(frozen=True, eq=False)
class Carriers:
    """Where the carriers' errors (I, 6) are among all that is estimated, and their deviations (6,)."""

    places: np.ndarray
    deviations: Array


def whitener(P: Array) -> Array:
    """W (V, 2n, k) with I - W W' = (I + P P')^(-1/2): what makes common errors P c, c ~ N(0, I), and unit noise white.

    With P = U S V', W is U (1 - (1 + S^2)^(-1/2))^(1/2).
    """
    U, S, _ = np.linalg.svd(P, full_matrices=False)
    W: Array = U * np.sqrt(1.0 - 1.0 / np.sqrt(1.0 + S**2))[:, None]
    return W


def whitened(rows: Array, W: Array) -> Array:
    """Rows (V, 2n, m) of unit noise and common errors, made white by their `whitener`."""
    result: Array = rows - W @ (W.transpose(0, 2, 1) @ rows)
    return result
