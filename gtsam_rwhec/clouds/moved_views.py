"""Views in which the thing was elsewhere: one view alone, or all from some view on.

The poses of a joint registration and those that A predicts differ by errors of A, and by what Y and X are off. A view
(or all from one on) whose thing has moved has six numbers of its own. They count if they explain far more than
independent errors of A would (an F test, with the share of false alarms over all views below ``FALSE_ALARMS``), and are
large.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from rwhec_factors import se3
from scipy.special import fdtrc

from gtsam_rwhec.geometry.poses import Array

#: Probability that a thing that did not move is said to have moved.
FALSE_ALARMS = 1e-5
#: Errors of an arm go with where it stands, and look like small moves (2.4 mm of a real arm, whichever thing it looked
#: at): a move is larger than what is left by a factor, and than a share of the thing's size. ``calibrate`` judges
#: smaller ones.
FAR, LARGE = 4.0, 0.08
#: Directions in which a pose is known to no better than this share of the thing's size tell nothing.
UNKNOWN = 0.1
#: Fewer views on both sides of a move cannot be told from other errors.
FEWEST = 3


@dataclass(frozen=True)
class Move:
    """The thing moved by ``distance_m`` in the view at place ``first``, or (``stays``) from it on."""

    first: int
    stays: bool
    distance_m: float


def move_of(poses: Array, predicted: Array, covariances: Array, units: Array, size_m: float) -> Move | None:
    """The move that explains most, if there is one.

    ``poses`` and ``predicted`` (N, 4, 4) are T_thing_sensor by the clouds and by A, about the thing's middle;
    ``covariances`` (N, 6, 6) are of the first; ``units`` (N, 6, 6) the perturbations that move the thing by a metre in
    each direction, and ``size_m`` is the thing's size.
    """
    order = np.arange(len(poses))
    to_unit = np.linalg.inv(units)
    values, vectors = np.linalg.eigh(to_unit @ covariances @ to_unit.transpose(0, 2, 1))
    is_told = values < (UNKNOWN * size_m) ** 2
    told = is_told[:, :, None] * vectors.transpose(0, 2, 1) @ to_unit
    residuals = (told @ se3.logmap(se3.inverse(predicted) @ poses)[..., None]).reshape(-1)
    by_thing = told @ se3.adjoint(se3.inverse(predicted))
    base = np.concatenate([by_thing, told], axis=2).reshape(-1, 12)
    _, before, free = _fitted(base, residuals, int(is_told.sum()))
    patterns = [(k, False, order == k) for k in range(len(poses))]
    patterns += [(k, True, order >= k) for k in range(FEWEST, len(poses) - FEWEST + 1)]
    best, least = None, FALSE_ALARMS / len(patterns)
    for first, stays, mask in patterns:
        own = (by_thing * mask[:, None, None]).reshape(-1, 6)
        solved, after, left = _fitted(np.hstack([base, own]), residuals, int(is_told.sum()))
        if left > 0 and free > left and after > 0.0:
            chance = float(fdtrc(free - left, left, (before - after) / (free - left) / (after / left)))
            # As views see it: along what slides, noise of the axes makes moves of any length.
            seen = vectors @ (own @ solved[12:]).reshape(-1, 6, 1)
            far = float(np.sqrt((seen[mask, 3:] ** 2).sum() / mask.sum()))
            if chance < least and far > max(FAR * np.sqrt(3.0 * after / left), LARGE * size_m):
                best, least = Move(first, stays, far), chance
    return best


def _fitted(rows: Array, right: Array, count: int) -> tuple[Array, float, int]:
    """Least squares: the solution, the squares that are left, and how many of ``count`` equations are over."""
    size = np.maximum(np.linalg.norm(rows, axis=0), 1e-300)
    solved, _, rank, _ = np.linalg.lstsq(rows / size, right, rcond=1e-9)
    return solved / size, float(((rows / size @ solved - right) ** 2).sum()), count - int(rank)
