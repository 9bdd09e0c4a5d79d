"""What the drive leaves free, and the covariance of the rest (design facts 8, 14 and 24).

H is the information with the windows' motions eliminated, N the part that the noise of the estimated motions alone
makes of it. A direction is free when its H is no more than its N would be by chance: the ratio follows an F
distribution. What is given is asked afterwards: it holds a direction or does not.
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
#: Information of what is given, per square metre or radian, above which it holds a direction: a deviation of one.
HOLDS = 1.0
#: A component of a free direction that is larger than this part of its largest makes a number infinite.
REACHES = 0.02
#: Ridge, as a part of each diagonal entry, that keeps factorisations of singular information from failing.
RIDGE = 1e-13


@dataclass(frozen=True)
class Freedom:
    """What is free, and the information of the rest."""

    by_data: Array  #: (p, f): directions that the drive leaves free, in units of 1 rad, metres, a scale times e
    left: Array  #: (p, l): those of them that what is given leaves free too
    information: Array  #: (p, p): h - N where the drive tells, plus that of what is given
    score: Array  #: (p, p): h plus that of what is given: the covariance of the gradient
    weakest: float  #: The smallest ratio of information over its threshold

    def complement(self) -> Array:
        """An orthonormal basis (p, p - l) of the directions that are determined."""
        return _complement(self.left)

    def covariance(self) -> Array:
        """(p, p), with no part along what is left free."""
        Z = self.complement()
        inner = Z.T @ self.information @ Z
        inverse = np.linalg.inv(inner + RIDGE * np.diag(np.diagonal(inner)))
        covariance: Array = Z @ inverse @ (Z.T @ self.score @ Z) @ inverse @ Z.T
        return covariance


def freedom(H: Array, N: Array, possible: Array, given: Array, layout: Layout, squares: float, spare: float) -> Freedom:
    """Test every direction.

    ``possible`` is N if the noise is as large as it may be: a direction that this explains is free. ``squares``: how
    many squares of noise a direction's information would sum; ``spare``: equations that tell the noise.
    """
    data = np.setdiff1d(np.arange(layout.size), layout.ground)
    Hd, Nd, Pd = (each[np.ix_(data, data)] for each in (H, N, possible))
    # Clocks have a weak prior, so that a clock that the drive does not tell is not what a pose is free by.
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
    weakest = float(1.0 / (share.max() * threshold)) if share.max() > 0.0 else np.inf
    return Freedom(by_data, _left(by_data, given, layout), informed + given, H + given, weakest)


def _left(by_data: Array, given: Array, layout: Layout) -> Array:
    """The free directions that what is given does not hold; the ground's own unknowns are eliminated."""
    if not by_data.shape[1]:
        return by_data
    g = layout.ground
    held = given
    if len(g):
        inner = np.linalg.inv(given[np.ix_(g, g)] + RIDGE * np.eye(len(g)))
        held = given - given[:, g] @ inner @ given[g]
    clocks = layout.at[layout.open[:, 7], 7]
    held = held.copy()
    held[clocks] = held[:, clocks] = 0.0
    values, vectors = np.linalg.eigh(by_data.T @ held @ by_data)
    left: Array = by_data @ vectors[:, values <= HOLDS]
    return left


def _complement(directions: Array) -> Array:
    if not directions.shape[1]:
        return np.eye(len(directions))
    U = np.linalg.svd(directions, full_matrices=True)[0]
    rest: Array = U[:, directions.shape[1] :]
    return rest


def seven_each(directions: Array, layout: Layout) -> Array:
    """Directions (p, l) as identifiability has them, (7 (m - 1) + 1, l): each sensor's pose and own scale; a zero."""
    padded = np.vstack([directions, np.zeros((1, directions.shape[1]))])
    rows = padded[layout.at[1:, : SCALE + 1].ravel()]
    result: Array = np.vstack([rows, np.zeros((1, directions.shape[1]))])
    return result
