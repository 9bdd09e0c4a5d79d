"""The test for a change: two estimates of the same quantities, against the sum of their covariances.

With z the whitened difference, |z|^2 is a chi-square of as many degrees of freedom as directions are compared
(dimension times an F, where covariances were estimated). Its power is spread over all of them, so that a change of one
frame of many is hard to see. So each group of quantities, a frame's pose or a size, is also tested for "this changed,
and nothing else did": the squared length of z's projection on the directions in which that group moves z. The alarm is
the smaller of the joint chance and, at a third of its weight, the smallest of a group times their number: one frame
gains by it, and a change of all of them hardly loses. The tests are not independent. So the chance of so small a value
without any change is counted over random z.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import chdtrc, fdtrc

from gtsam_rwhec.errors import OptionError
from gtsam_rwhec.files.terminal_text import brief
from gtsam_rwhec.fitting.joint_covariance import SHARE
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.geometry.real_numbers import is_real

#: The level at which something counts as changed, unless another one is asked for.
LEVEL = 0.01
#: The weight of the groups' tests beside the joint one.
OF_GROUPS = 1.0 / 3.0
#: Number of random differences without a change, and the most elements of their array.
DRAWS, MOST_NUMBERS = 20_000, 2_000_000
#: If fewer random differences fall below a chance, it is bounded by the sum of the chances of both tests.
FEWEST_DRAWS = 50
#: A direction shorter than this share of the longest one is taken as rounding error.
ROUNDING = 1e-9


@dataclass(frozen=True)
class GroupChange:
    """The test of one group of quantities: a frame's pose, a size, a clock, or a camera's intrinsics."""

    dimension: int  #: Directions that were compared; 0 where both estimates leave all of them free
    #: The group's own difference, in joint (Mahalanobis) deviations: the root of d' C^-1 d, correlations counted
    deviations: float
    chance: float  #: How often the difference is so large without a change
    corrected: float  #: The same where the largest of all groups is looked at (Holm 1979)
    alone: float  #: How often "only this changed" looks so well supported without a change
    explains: bool  #: Whether nothing more than chance is left if only this group changed


@dataclass(frozen=True)
class ChangeTest:
    """The result of the test."""

    level: float
    dimension: int  #: Directions that were compared together
    deviations: float  #: The root of the joint statistic
    degrees_of_freedom: float  #: Of the noise, which was estimated; infinite for chi-square quantiles
    joint_chance: float  #: How often the joint statistic is so large without a change
    chance: float  #: The same of the alarm
    groups: dict[str, GroupChange]

    @property
    def has_changed(self) -> bool:
        """Whether something changed by more than chance, at the level."""
        return self.chance < self.level

    @property
    def changed(self) -> tuple[str, ...]:
        """The groups that changed, as far as they can be named; empty without an alarm, or if none stands out.

        These are the groups that differ by themselves; if none does, the group whose change alone explains the alarm
        best.
        """
        if not self.has_changed:
            return ()
        own = tuple(name for name, group in self.groups.items() if group.corrected < self.level)
        if own:
            return own
        explaining = {name: group.alone for name, group in self.groups.items() if group.explains}
        return (min(explaining, key=lambda name: explaining[name]),) if explaining else ()


def checked_level(level: float) -> float:
    """The level, if it is between 0 and 1. Raises OptionError for any other."""
    if not (is_real(level) and 0.0 < level < 1.0):
        raise OptionError(f"level={brief(level)}; give one between 0 and 1, such as {LEVEL}")
    return float(level)


def change_test(
    difference: Array,
    covariances: tuple[Array, Array],
    free: Array,
    groups: Mapping[str, slice],
    degrees_of_freedom: tuple[float, float],
    level: float = LEVEL,
) -> ChangeTest:
    """Test a difference of two independent estimates.

    Parameters
    ----------
    difference : (m,) array
        The second estimate less the first, each number in a unit in which all are of similar size.
    covariances : two (m, m) arrays
        Of both estimates, in the same units.
    free : (m, k) array
        Directions of infinite variance in either; they are not compared.
    groups : dict of str to slice
        The rows of each group.
    degrees_of_freedom : (float, float)
        Of each covariance; infinite where the noise was given.
    level : float
    """
    checked_level(level)
    Q = _complement(free)
    both = [Q.T @ C @ Q for C in covariances]
    W = _whitening(both[0] + both[1])
    z, size = W @ (Q.T @ difference), len(W)
    # Welch and Satterthwaite's: each estimate's share of the variance has its own degrees of freedom.
    shares = [float(np.einsum("ij,jk,ik->", W, C, W)) / max(size, 1) for C in both]
    uncertain = sum(share**2 / freedom for share, freedom in zip(shares, degrees_of_freedom, strict=True))
    freedom = 1.0 / uncertain if uncertain > 0.0 else math.inf
    square = float(z @ z)
    joint = float(_tail(square, size, freedom))
    moved = {name: _span(W @ Q[rows].T) for name, rows in groups.items()}
    found = {}
    for name, rows in groups.items():
        own, dimension = _own(difference[rows], covariances[0][rows, rows] + covariances[1][rows, rows], free[rows])
        along, directions = float(((moved[name].T @ z) ** 2).sum()), moved[name].shape[1]
        found[name] = GroupChange(
            dimension=dimension,
            deviations=math.sqrt(own),
            chance=float(_tail(own, dimension, freedom)),
            corrected=1.0,
            alone=float(_tail(along, directions, freedom)),
            explains=bool(directions and float(_tail(square - along, size - directions, freedom)) >= level),
        )
    corrected = _holm({name: group.chance for name, group in found.items() if group.dimension})
    alone = [found[name].alone for name, U in moved.items() if U.shape[1]]
    smallest = min(joint, len(alone) * min(alone, default=1.0) / OF_GROUPS)
    return ChangeTest(
        level=level,
        dimension=size,
        deviations=math.sqrt(square),
        degrees_of_freedom=freedom,
        joint_chance=joint,
        chance=_calibrated(smallest, size, freedom, [U for U in moved.values() if U.shape[1]]),
        groups={name: replace(group, corrected=corrected.get(name, 1.0)) for name, group in found.items()},
    )


def _tail(square: Array | float, dimension: int, freedom: float) -> Array:
    """The chance that a squared length of this many dimensions is larger."""
    if not dimension:
        return np.ones_like(square)
    square = np.maximum(square, 0.0)
    if math.isinf(freedom):
        return np.asarray(chdtrc(dimension, square))
    return np.asarray(fdtrc(dimension, freedom, square / dimension))


def _calibrated(smallest: float, size: int, freedom: float, moved: list[Array]) -> float:
    """The chance that the smaller of the two chances is so small without a change.

    It is counted over random differences, always the same ones. Below ``FEWEST_DRAWS`` of them it is the sum of both
    chances; where everything is one group, it is the joint one.
    """
    if not size or (len(moved) == 1 and moved[0].shape[1] == size):
        return min(smallest, 1.0)
    bound = min((1.0 + OF_GROUPS) * smallest, 1.0)
    number = min(DRAWS, max(MOST_NUMBERS // size, FEWEST_DRAWS))
    chance = np.random.default_rng(0)
    z = chance.standard_normal((number, size))
    if not math.isinf(freedom):
        z *= np.sqrt(freedom / chance.chisquare(freedom, number))[:, None]
    least = _tail(np.einsum("ni,ni->n", z, z), size, freedom)
    for U in moved:
        along = z @ U
        least = np.minimum(
            least, len(moved) / OF_GROUPS * _tail(np.einsum("ni,ni->n", along, along), U.shape[1], freedom)
        )
    below = int((least <= smallest).sum())
    return min(bound, below / number) if below >= FEWEST_DRAWS else bound


def _complement(free: Array, least: float | None = None) -> Array:
    """A basis (m, r) of all directions that are orthogonal to ``free``, whose lengths up to ``least`` are none."""
    U, s, _ = np.linalg.svd(free, full_matrices=True)
    least = ROUNDING * s.max(initial=0.0) if least is None else least
    return U[:, int((s > least).sum()) :]


def _whitening(covariance: Array) -> Array:
    """W (r, m) with W C W' = 1, over the directions that have a variance."""
    size = np.sqrt(np.diagonal(covariance))
    has = size > 0.0
    if not has.any():
        return np.zeros((0, len(covariance)))
    values, vectors = np.linalg.eigh(covariance[np.ix_(has, has)] / size[has, None] / size[has])
    kept = values > ROUNDING * values.max()
    W = np.zeros((int(kept.sum()), len(covariance)))
    W[:, has] = (vectors[:, kept] / np.sqrt(values[kept])).T / size[has]
    return W


def _span(columns: Array) -> Array:
    """An orthonormal basis of the columns; only their directions count, not their lengths."""
    length = np.linalg.norm(columns, axis=0)
    columns = columns[:, length > ROUNDING * length.max(initial=0.0)] if length.any() else columns[:, :0]
    if not columns.shape[1]:
        return columns
    U, s, _ = np.linalg.svd(columns / np.linalg.norm(columns, axis=0), full_matrices=False)
    return U[:, s > ROUNDING * s.max()]


def _own(difference: Array, covariance: Array, free: Array) -> tuple[float, int]:
    """The squared joint deviation of one group, without the directions that are free, and the number of directions."""
    Q = _complement(free, SHARE)
    W = _whitening(Q.T @ covariance @ Q)
    return float(((W @ (Q.T @ difference)) ** 2).sum()), len(W)


def _holm(chances: Mapping[str, float]) -> dict[str, float]:
    """Chances corrected for their number: the k-th smallest of n counts n - k + 1 times (Holm 1979)."""
    corrected, largest = {}, 0.0
    for i, name in enumerate(sorted(chances, key=lambda each: chances[each])):
        largest = max(largest, min(1.0, (len(chances) - i) * chances[name]))
        corrected[name] = largest
    return corrected
