"""Free directions at a refined answer, as columns over the refinement's unknowns."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gtsam_rwhec.fitting.pair_data import FactorsByPair, PairData
from gtsam_rwhec.fitting.unknowns import State, Unknown, UnknownKind, Variables, slots_of
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.solver.answers import PairPoses, costs_of_pairs, given_answer
from gtsam_rwhec.solver.free_directions import FreeDirection, FreeKind, FreeReason
from gtsam_rwhec.solver.identification import identify_with_basis, typical_length
from gtsam_rwhec.solver.parts import Part

#: A carrier stands still when its velocity's mean square is at most this many times the part that noise explains.
MOVED = 4.0

#: The one scale of all targets.
SHARED = Unknown(UnknownKind.SCALE)


@dataclass(frozen=True)
class FreeSpace:
    """Free directions."""

    #: (d, k): the directions over ``Variables.unknowns``, with the small shares that the records leave out.
    basis: Array
    #: The same directions as records.
    directions: tuple[FreeDirection, ...]
    #: (d,): the unit of each parameter: 1 rad, the typical length (m), a scale's value, 1 s.
    unit: Array
    #: By sensor: the share by which noise in the carrier's velocity pulls the time offset towards zero.
    shrinkage: dict[str, float]


def free_space_of(
    parts: list[Part], variables: Variables, state: State, data: list[PairData], fitted: FactorsByPair | None = None
) -> FreeSpace:
    """The free directions, by the certified solution's test (``identifiability``), at the refined answer.

    The residuals give the noise. Under a robust loss they contain outliers, so there the ``fitted`` factors give it.
    """
    slots = slots_of(variables.unknowns)
    size = sum(unknown.dimension for unknown in slots)
    unit = np.ones(size)
    directions: list[FreeDirection] = []
    columns = [np.zeros((size, 0))]
    for part in parts:
        answer = given_answer(part, state.X, state.Y, _scales_of(part, state))
        poses = PairPoses.of(part, answer)
        J_t, J_R = costs_of_pairs(part, poses)
        if fitted is not None:  # the costs that these factors predict, 3 / 2 for each measurement
            factors = np.array([fitted[pair] for pair in part.pairs])
            J_R, J_t = 1.5 * part.moments.count * factors[:, 0], 1.5 * part.moments.count * factors[:, 1]
        known, free = identify_with_basis(part, poses, J_t, J_R)
        directions += known.free_directions
        basis = np.zeros((size, free.shape[1]))
        changes = {SHARED: free[-1]}  # of the logarithm of each scale
        length = typical_length(part)
        for name, of_frame in zip(part.free, free[:-1].reshape(len(part.free), 7, free.shape[1]), strict=True):
            frame = slots[Unknown(UnknownKind.FRAME, name)]
            unit[frame] = np.r_[np.ones(3), np.full(3, length)]
            basis[frame] = of_frame[:6]
            changes[Unknown(UnknownKind.SCALE, name)] = of_frame[6]
        for scale in changes.keys() & slots.keys():  # d alpha = alpha d log alpha
            basis[slots[scale]] = state.scales[scale] * changes[scale]
        columns.append(basis)
    offsets, shrinkage = free_offsets(data, variables)
    directions += offsets
    for offset in offsets:
        (sensor,) = offset.time_offsets_s
        column = np.zeros((size, 1))
        column[slots[Unknown(UnknownKind.TIME_OFFSET, sensor)]] = 1.0
        columns.append(column)
    for scale, value in state.scales.items():
        unit[slots[scale]] = value
    return FreeSpace(np.hstack(columns), tuple(directions), unit, shrinkage)


def free_offsets(data: list[PairData], variables: Variables) -> tuple[list[FreeDirection], dict[str, float]]:
    """Time offsets that the carriers' motion does not determine, and ``FreeSpace.shrinkage`` of the other sensors.

    A carrier must move to determine a time offset. Its velocity comes from noisy poses, and between poses that are far
    apart the path is not known. If the velocity's mean square
    is at most ``MOVED`` times the part that this explains, the carrier counts as standing still.
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
            variance = item.count * item.paths.velocity_variance.reshape(2, 3).sum(axis=1)
            if item.carrier is not None:
                stated = np.einsum("nii->i", item.carrier).reshape(2, 3).sum(axis=1) / item.count
                variance = np.maximum(variance, item.paths.leverage.sum() * stated)
            noise += weight * variance
        if (squares <= MOVED * noise + 1e-18 * np.maximum(squares.max(), 1.0)).all():
            free.append(FreeDirection(FreeKind.TIME_OFFSET, FreeReason.STANDSTILL, time_offsets_s={sensor: 1.0}))
        else:
            shrinkage[sensor] = float(noise.sum() / squares.sum())
    return free, shrinkage


def _scales_of(part: Part, state: State) -> float | dict[str, float]:
    if part.scale == "per_target":
        return {name: state.scales[Unknown(UnknownKind.SCALE, name)] for name in part.scale_owners}
    return state.scales.get(SHARED, 1.0)
