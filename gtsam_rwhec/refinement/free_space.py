"""Directions that the measurements leave free at a refined answer, as columns over the refinement's unknowns."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.identifiability.free_directions import FreeDirection, FreeKind, FreeReason
from gtsam_rwhec.identifiability.identification import identify, typical_length
from gtsam_rwhec.refinement.pair_data import PairData
from gtsam_rwhec.refinement.unknowns import Unknown, UnknownKind, slots_of
from gtsam_rwhec.refinement.variables import State, Variables
from gtsam_rwhec.refinement.weighting import FactorsByPair
from gtsam_rwhec.solver.parts import Part
from gtsam_rwhec.solver.residuals import PairPoses, costs_of_pairs
from gtsam_rwhec.solver.variables import given_answer

#: A velocity's mean square, in units of what noise makes of it, up to which a carrier counts as standing still.
MOVED = 4.0

#: The one scale of all targets.
SHARED = Unknown(UnknownKind.SCALE)


@dataclass(frozen=True)
class FreeSpace:
    """Free directions: basis (d, k) over ``Variables.unknowns`` and as records; unit (d,): what counts as one of each.

    ``shrinkage``: see ``free_offsets``.
    """

    basis: Array
    directions: tuple[FreeDirection, ...]
    unit: Array
    shrinkage: dict[str, float]


def free_space_of(
    parts: list[Part],
    variables: Variables,
    state: State,
    data: list[PairData],
    fitted: FactorsByPair | None = None,
) -> FreeSpace:
    """Tested as the certified solution's are (``identifiability``), at the refined answer.

    The residuals tell the noise; where a loss holds outliers off, which are among them, the noise as ``fitted`` does.
    """
    slots = slots_of(variables.unknowns)
    size = sum(unknown.dimension for unknown in slots)
    unit = np.ones(size)
    directions: list[FreeDirection] = []
    for part in parts:
        answer = given_answer(part, state.X, state.Y, _scales_of(part, state))
        poses = PairPoses.of(part, answer)
        J_t, J_R = costs_of_pairs(part, poses)
        if fitted is not None:  # what these factors predict, 3 / 2 a measurement
            factors = np.array([fitted[pair] for pair in part.pairs])
            J_R, J_t = 1.5 * part.moments.count * factors[:, 0], 1.5 * part.moments.count * factors[:, 1]
        directions += identify(part, poses, J_t, J_R).free_directions
        length = typical_length(part)
        for name in part.free:
            unit[slots[Unknown(UnknownKind.FRAME, name)]] = np.r_[np.ones(3), np.full(3, length)]
    offsets, shrinkage = free_offsets(data, variables)
    directions += offsets
    for scale, value in state.scales.items():
        unit[slots[scale]] = value
    basis = np.zeros((size, len(directions)))
    for direction, column in zip(directions, basis.T, strict=True):
        for name, xi in direction.frames.items():
            column[slots[Unknown(UnknownKind.FRAME, name)]] = xi
        for owner, change in ({SHARED.owner: direction.scale} | direction.own_scales).items():
            scale = Unknown(UnknownKind.SCALE, owner)
            if scale in slots:  # d alpha = alpha d log alpha
                column[slots[scale]] = state.scales[scale] * change
        for sensor, change_s in direction.time_offsets_s.items():
            column[slots[Unknown(UnknownKind.TIME_OFFSET, sensor)]] = change_s
    return FreeSpace(basis, tuple(directions), unit, shrinkage)


def free_offsets(data: list[PairData], variables: Variables) -> tuple[list[FreeDirection], dict[str, float]]:
    """Time offsets that the carriers' motion does not tell.

    An offset shows as far as the carrier moves while the sensor looks. Its velocity comes from noisy poses: where its
    mean square is no more than ``MOVED`` times what their noise alone would make it, the carrier stood still for all
    that is known.

    Returns
    -------
    free : list of FreeDirection
    shrinkage : dict of str to float
        Of the other sensors: by what part noise in the velocity pulls the offset towards zero.
    """
    free: list[FreeDirection] = []
    shrinkage: dict[str, float] = {}
    for sensor in variables.offsets:
        squares, noise = np.zeros(2), np.zeros(2)
        for item in data:
            if item.pair.sensor != sensor or item.paths is None:
                continue
            weight = 1.0 / np.einsum("nii->i", item.covariance).reshape(2, 3).mean(axis=1) * item.count
            squares += weight * (item.paths.twists() ** 2).sum(axis=0).reshape(2, 3).sum(axis=1)
            variance = item.paths.scatter.reshape(2, 3).sum(axis=1)
            if item.carrier is not None:
                variance = np.maximum(
                    variance, np.einsum("nii->i", item.carrier).reshape(2, 3).sum(axis=1) / item.count
                )
            noise += weight * item.paths.leverage.sum() * variance
        if (squares <= MOVED * noise + 1e-18 * np.maximum(squares.max(), 1.0)).all():
            free.append(FreeDirection(FreeKind.TIME_OFFSET, FreeReason.STANDSTILL, time_offsets_s={sensor: 1.0}))
        else:
            shrinkage[sensor] = float(noise.sum() / squares.sum())
    return free, shrinkage


def _scales_of(part: Part, state: State) -> float | dict[str, float]:
    if part.scale == "per_target":
        return {name: state.scales[Unknown(UnknownKind.SCALE, name)] for name in part.scale_owners}
    return state.scales.get(SHARED, 1.0)
