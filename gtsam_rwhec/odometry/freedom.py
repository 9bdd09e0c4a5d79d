"""What the drive leaves free, and the covariance of the rest (design facts 8, 14 and 24).

H is the information with the windows' motions eliminated. N is the part of H that the noise of the estimated motions
alone produces. A direction is free if its H is no larger than N can be by chance: the ratio follows an F distribution.
Afterwards each free direction is compared with the prior knowledge, which may determine it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.linalg
from scipy.special import chdtri, fdtri

from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.odometry.window_likelihood import SCALE, Layout

#: The probability that a free direction counts as determined: a fleet has many drives.
SIGNIFICANCE = 1e-6
#: Prior knowledge with more information than this, per square metre or radian, determines a direction.
HOLDS = 1.0
#: A variance is infinite if its component of a free direction exceeds this part of the largest component.
REACHES = 0.02
#: Ridge, as a part of each diagonal entry, that keeps factorisations of singular information from failing.
RIDGE = 1e-13


@dataclass(frozen=True)
class Freedom:
    """The free directions, and the information about the others."""

    by_data: Array  #: (p, f): directions that the drive leaves free, in units of 1 rad, metres, a scale times e
    left: Array  #: (p, l): directions that prior knowledge leaves free too
    information: Array  #: (p, p): H - N along determined directions, plus that of prior knowledge
    score: Array  #: (p, p): H plus that of prior knowledge: the covariance of the gradient

    def complement(self) -> Array:
        """An orthonormal basis (p, p - l) of the directions that are determined."""
        if not self.left.shape[1]:
            return np.eye(len(self.left))
        rest: Array = np.linalg.svd(self.left, full_matrices=True)[0][:, self.left.shape[1] :]
        return rest

    def inverse(self) -> Array:
        """The inverse (p, p) of the information, zero along the directions that are left free."""
        Z = self.complement()
        inner = Z.T @ self.information @ Z
        inverse: Array = Z @ np.linalg.inv(inner + RIDGE * np.diag(np.diagonal(inner))) @ Z.T
        return inverse

    def covariance(self) -> Array:
        """(p, p), zero along the directions that are left free."""
        inverse = self.inverse()
        return inverse @ self.score @ inverse


def freedom(H: Array, N: Array, possible: Array, given: Array, layout: Layout, squares: float, spare: float) -> Freedom:
    """Test every direction.

    ``possible`` is N for the largest plausible noise: a direction that it explains is free. ``squares`` and
    ``spare`` are the F distribution's degrees of freedom: squares of noise in a direction's information, and
    spare equations, which determine the noise.
    """
    data = np.setdiff1d(np.arange(layout.size), layout.ground)
    Hd, Nd, Pd = (each[np.ix_(data, data)] for each in (H, N, possible))
    # A weak prior on clocks: a clock that the drive does not determine must not make a pose free.
    clocks = layout.at[layout.open[:, 7], 7]
    of_clocks = np.zeros(layout.size)
    of_clocks[clocks] = np.diagonal(given)[clocks]
    whole = Hd + np.diag(of_clocks[data])
    unit = 1.0 / np.sqrt(np.maximum(np.diagonal(whole) + np.diagonal(Pd), 1e-200))
    scaled = whole * unit[:, None] * unit + RIDGE * np.eye(len(data))
    # With V'HV = I and W = V^-T: H = W W', and a direction's share of noise is a diagonal entry of V'NV.
    share, V = scipy.linalg.eigh(Pd * unit[:, None] * unit, scaled)
    threshold = float(
        fdtri(squares, spare, 1.0 - SIGNIFICANCE) if spare > 0.0 else chdtri(squares, SIGNIFICANCE) / squares
    )
    is_free = share * threshold >= 1.0
    W = np.linalg.inv(V).T / unit[:, None]
    noise = V.T @ (Nd * unit[:, None] * unit) @ V
    told = np.eye(len(data)) - noise
    told[is_free], told[:, is_free] = 0.0, 0.0
    informed = np.zeros((layout.size, layout.size))
    informed[np.ix_(data, data)] = W @ told @ W.T
    informed -= np.diag(of_clocks)  # they come back with what is given
    by_data = np.zeros((layout.size, int(is_free.sum())))
    by_data[data] = V[:, is_free] * unit[:, None]
    by_data = np.linalg.qr(by_data)[0] if by_data.size else by_data
    return Freedom(by_data, _left(by_data, given, layout), informed + given, H + given)


def _left(by_data: Array, given: Array, layout: Layout) -> Array:
    """The free directions that prior knowledge does not determine; the ground's unknowns are eliminated."""
    if not by_data.shape[1]:
        return by_data
    g = layout.ground
    inner = np.linalg.inv(given[np.ix_(g, g)] + RIDGE * np.eye(len(g)))
    held = given - given[:, g] @ inner @ given[g]
    clocks = layout.at[layout.open[:, 7], 7]
    held[clocks] = held[:, clocks] = 0.0
    values, vectors = np.linalg.eigh(by_data.T @ held @ by_data)
    left: Array = by_data @ vectors[:, values <= HOLDS]
    return left


def seven_each(directions: Array, layout: Layout) -> Array:
    """Directions (p, l) in identifiability's order, (7 (m - 1) + 1, l): each sensor's pose and scale; a zero."""
    padded = np.vstack([directions, np.zeros((1, directions.shape[1]))])
    rows = padded[layout.at[1:, : SCALE + 1].ravel()]
    result: Array = np.vstack([rows, np.zeros((1, directions.shape[1]))])
    return result
