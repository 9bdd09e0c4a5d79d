"""Covariances from an information matrix with free directions: infinite along these, finite elsewhere.

F are the free directions (``FreeSpace``), and Q spans their orthogonal complement. With a prior of variance tau along F
the covariance is, for tau to infinity,

    tau F F' + Q (Q' Lambda Q)^-1 Q'

so it is finite for every function that F does not change, and infinite for the others. For such a matrix GTSAM's
Marginals raise an error or return 1e18.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from rwhec_factors import se3
from scipy.linalg import block_diag
from scipy.linalg.lapack import dpotri

from gtsam_rwhec.errors import FrameError
from gtsam_rwhec.fitting.pair_data import FactorsByPair, PairData
from gtsam_rwhec.fitting.unknowns import State, Unknown, UnknownKind, Variables, rows_of, slots_of
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.solver.answers import PairPoses, costs_of_pairs, given_answer
from gtsam_rwhec.solver.free_directions import FreeDirection, FreeKind, FreeReason
from gtsam_rwhec.solver.identification import identify_with_basis, typical_length
from gtsam_rwhec.solver.parts import Part

#: A linear function is determined when its share along the free directions is below this. (A free direction's sentence
#: leaves out frames below the same share.)
SHARE = 0.05
#: An estimate counts as this far from the truth along a free direction, in units (the typical length).
DISPLACED = 1.0
#: An eigenvalue of an equilibrated information is rounding error below this share of the largest one.
ROUNDING = 1e-13


@dataclass(frozen=True)
class JointCovariance:
    """The covariance of all unknowns together: dense, d x d."""

    #: The rows of each unknown.
    slots: dict[Unknown, slice]
    #: (d, d): Q (Q' Lambda Q)^-1 Q'.
    finite: Array
    #: (d, k): Directions of infinite variance, orthonormal in units of ``unit``.
    free: Array
    #: (d,): The unit of each parameter: 1 rad, the typical length (m), a scale's value, 1 s.
    unit: Array

    @staticmethod
    def of(unknowns: tuple[Unknown, ...], information: Array, free: Array, unit: Array) -> JointCovariance:
        """The inverse of an information (d, d) of the unknowns in their order.

        ``free`` (d, k) are the free directions in the parameters' own units; k may be 0.
        """
        scaled = information * unit[:, None] * unit
        scaled = 0.5 * (scaled + scaled.T)
        basis = _orthonormal(free / unit[:, None])
        has_free = bool(basis.shape[1])
        Q = np.linalg.svd(basis, full_matrices=True)[0][:, basis.shape[1] :] if has_free else np.eye(len(unit))
        inside = Q.T @ scaled @ Q if has_free else scaled
        # Equilibrated, so that each parameter's own information is the scale of its rounding.
        # What is below the rounding of the largest, once directions are mixed, is nothing.
        diagonal = np.diagonal(inside)
        least = ROUNDING**2 * diagonal.max(initial=0.0) if has_free else 0.0
        size = np.sqrt(np.maximum(diagonal, max(least, 1e-300)))
        inside = inside / size[:, None] / size
        if not has_free and len(unit) > SMALL:
            inverse = _surely_definite_inverse(inside)
            if inverse is not None:
                share = unit / size
                return JointCovariance(slots_of(unknowns), inverse * share[:, None] * share, basis, unit)
        values, vectors = np.linalg.eigh(inside)
        lost = values <= ROUNDING * values.max(initial=0.0)
        if lost.any():  # no measurement depends on these directions
            more = Q @ (vectors[:, lost] / size[:, None])
            more /= np.abs(more).max(axis=0)  # a parameter without information has a size of 1e-150
            return JointCovariance.of(unknowns, information, np.hstack([free, more * unit[:, None]]), unit)
        root = Q @ (vectors / np.sqrt(values) / size[:, None])
        finite = (root @ root.T) * np.outer(unit, unit)
        return JointCovariance(slots_of(unknowns), finite, basis, unit)

    def rows(self, unknowns: tuple[Unknown, ...]) -> np.ndarray:
        """The row indices of some unknowns, in the order given; FrameError for one not in `slots`."""
        for unknown in unknowns:
            if unknown not in self.slots:
                there = ", ".join(map(str, self.slots))
                raise FrameError(f"{str(unknown)!r} is not among the unknowns; they are {there}")
        return rows_of(self.slots, unknowns)

    def without(self, others: Collection[Unknown]) -> JointCovariance:
        """The covariance of the unknowns beside some others."""
        kept = tuple(unknown for unknown in self.slots if unknown not in others)
        rows = self.rows(kept)
        return JointCovariance(slots_of(kept), self.finite[np.ix_(rows, rows)], self.free[rows], self.unit[rows])

    def selector(self, unknowns: tuple[Unknown, ...]) -> Array:
        """The matrix (m, d) that selects the rows of some unknowns."""
        rows = self.rows(unknowns)
        selected: Array = np.zeros((len(rows), len(self.unit)))
        selected[np.arange(len(rows)), rows] = 1.0
        return selected

    def reach(self, G: Array) -> Array:
        """The movement (m, k) of the rows of G along each free direction that moves one parameter by a unit."""
        if self.free.shape[1] == 0:
            return np.zeros((len(G), 0))
        # The largest entry sets the length: a direction may move many frames.
        largest = np.linalg.norm(self.free, axis=1).max()
        moved: Array = (G * self.unit) @ self.free / largest
        return moved

    def covariance_of(self, G: Array) -> Array:
        """The covariance (m, m) of the linear functions G (m, d) of the unknowns.

        The variance of every row that a free direction changes is infinite. If a direction changes two
        rows, their covariance is infinite too, with the sign of their correlation. A row that a direction changes by
        less than ``SHARE`` keeps a finite variance, which includes a displacement by ``DISPLACED`` units along the
        direction.
        """
        moved = self.reach(G)
        length = np.linalg.norm(G * self.unit, axis=1)
        shares = moved / np.where(length > 0.0, length, 1.0)[:, None]
        touched = np.linalg.norm(shares, axis=1) > SHARE
        used = np.flatnonzero(G.any(axis=0))  # few of many unknowns
        of_used = G[:, used]
        covariance: Array = of_used @ self.finite[used[:, None], used] @ of_used.T + DISPLACED**2 * moved @ moved.T
        along = shares @ shares.T
        reached = touched[:, None] & touched & (np.abs(along) > SHARE**2 * 1e-3)
        covariance[reached] = np.inf * np.sign(along[reached])
        return covariance

    def information_of(self, unknowns: tuple[Unknown, ...]) -> Array:
        """The marginal information (m, m): the inverse of the finite covariance, and 0 along free directions."""
        chosen = self.selector(unknowns)
        unit = self.unit[self.rows(unknowns)]
        moved = self.reach(chosen) / unit[:, None]
        # Functions of these unknowns that free directions change, strongest first; those below SHARE are displaced.
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
        """The covariance (m, m) that a rotation's error adds to a frame that is displaced along a free direction.

        An error omega of the rotation turns the free direction with it: a frame displaced by f moves by omega x f. The
        term is of second order, but f is not small.
        """
        rows = self.rows((unknown,))
        result = np.zeros((len(rows), len(rows)))
        if len(rows) == 6:
            for f in DISPLACED * self.reach(self.selector((unknown,)))[3:].T:
                across = se3.hat(f)
                result[3:, 3:] += across @ self.finite[np.ix_(rows[:3], rows[:3])] @ across.T
        return result


def _surely_definite_inverse(information: Array) -> Array | None:
    """The inverse, without eigenvalues; None where one of these may be rounding error."""
    try:
        inverse, _ = EliminationOrder.of(information).inverse(information)
    except np.linalg.LinAlgError:
        return None
    largest, smallest = (np.abs(each).sum(axis=0).max() for each in (information, inverse))  # at least, and its inverse
    return inverse if ROUNDING * largest * smallest < 1.0 else None


def _orthonormal(basis: Array) -> Array:
    """An orthonormal basis of the columns' span."""
    if basis.shape[1] == 0:
        return basis
    U, s, _ = np.linalg.svd(basis / np.maximum(np.linalg.norm(basis, axis=0), 1e-300), full_matrices=False)
    span: Array = U[:, s > 1e-9 * max(s[0], 1e-300)]
    return span


#: Smaller matrices are inverted as a whole.
SMALL = 120


@dataclass(frozen=True)
class EliminationOrder:
    """Which parameters are eliminated at once, before the rest."""

    #: (n, w): n blocks of w parameters, which nothing ties to one another.
    blocks: np.ndarray

    @staticmethod
    def of(matrix: Array) -> EliminationOrder:
        """For matrices (d, d) that are zero where this one is; its parameters with the same ties are blocks."""
        best = np.zeros((0, 1), dtype=np.int64)
        if len(matrix) <= SMALL:
            return EliminationOrder(best)
        tied = (matrix != 0.0) | np.eye(len(matrix), dtype=bool)
        alike: dict[bytes, list[int]] = {}
        for i, ties in enumerate(np.packbits(tied, axis=1)):
            alike.setdefault(ties.tobytes(), []).append(i)
        blocks = list(alike.values())
        first = [block[0] for block in blocks]
        neighbours = tied[np.ix_(first, first)]
        np.fill_diagonal(neighbours, val=False)
        widths = np.array([len(block) for block in blocks])
        fewest_first = np.argsort(neighbours.sum(axis=1), kind="stable")
        for width in np.unique(widths):
            found, is_free = [], widths == width
            for number in fewest_first:
                if is_free[number]:
                    found.append(blocks[number])
                    is_free &= ~neighbours[number]
            if len(found) > 1 and len(found) * width > best.size:
                best = np.array(found)
        return EliminationOrder(best)

    def split(self, matrix: Array) -> Arrow:
        """A matrix (d, d) of this pattern."""
        own, others = self.blocks, np.delete(np.arange(len(matrix)), self.blocks.ravel())
        alone, ties = matrix[own[:, :, None], own[:, None]], matrix[own[:, :, None], others]
        return Arrow(own, others, alone, ties, matrix[others[:, None], others])

    def inverse(self, matrix: Array) -> tuple[Array, float]:
        """The inverse of a matrix of this pattern, and log|matrix|; LinAlgError if it is not positive definite."""
        if not self.blocks.size:
            L = np.linalg.cholesky(matrix)
            return _inverse_of(L), 2.0 * float(np.log(np.diagonal(L)).sum())
        inverse = self.split(matrix).inverse()
        own, across = self.blocks, inverse.across
        flat, others = own.ravel(), inverse.of.others
        result = np.empty_like(matrix)
        result[:, others] = across
        result[others[:, None], flat] = across[flat].T
        result[flat[:, None], flat] = across[flat] @ inverse.through[flat].T
        result[own[:, :, None], own[:, None]] += inverse.alone
        return result, inverse.log_det


def _inverse_of(L: Array) -> Array:
    """(L L')^-1 of a Cholesky factor (m, m)."""
    upper = dpotri(L.T, lower=0)[0] if len(L) else L  # its lower triangle is zero, as that of L'
    found: Array = upper + upper.T
    np.fill_diagonal(found, np.diagonal(upper))
    return found


@dataclass(frozen=True, eq=False)
class Arrow:
    """A symmetric matrix of blocks and the rest."""

    #: (n, w) and (m,): Their parameters.
    blocks: np.ndarray
    others: np.ndarray
    #: (n, w, w), (n, w, m) and (m, m): The blocks' own, between them and the rest, and the rest's.
    alone: Array
    ties: Array
    rest: Array

    def __add__(self, other: Arrow) -> Arrow:
        """The sum with a matrix of the same blocks."""
        return replace(self, alone=self.alone + other.alone, ties=self.ties + other.ties, rest=self.rest + other.rest)

    def with_more(self, ties: Array, own: Array) -> Arrow:
        """The same with k parameters more in the rest: their products (k, d) with those before, and (k, k)."""
        others = np.append(self.others, ties.shape[1] + np.arange(len(own)))
        of_blocks, of_rest = ties[:, self.blocks].transpose(1, 2, 0), ties[:, self.others]
        rest = np.block([[self.rest, of_rest.T], [of_rest, own]])
        return Arrow(self.blocks, others, self.alone, np.concatenate([self.ties, of_blocks], axis=2), rest)

    def inverse(self) -> ArrowInverse:
        """LinAlgError if it is not positive definite."""
        L = np.linalg.cholesky(self.alone)
        alone = np.linalg.inv(self.alone)
        flat, m = self.blocks.ravel(), len(self.others)
        through = np.empty((len(flat) + m, m))
        through[self.blocks], through[self.others] = -(alone @ self.ties), np.eye(m)
        L_rest = np.linalg.cholesky(self.rest + self.ties.reshape(len(flat), m).T @ through[flat])
        diagonal = np.r_[np.diagonal(L, axis1=1, axis2=2).ravel(), np.diagonal(L_rest)]
        return ArrowInverse(self, alone, through, L_rest, 2.0 * float(np.log(diagonal).sum()))


@dataclass(frozen=True, eq=False)
class ArrowInverse:
    """The inverse; d parameters. With the blocks D, the rest R and B between them, S = R - B' D^-1 B, it is

    [D^-1 0; 0 0] + U S^-1 U',    U = [-D^-1 B; 1]
    """

    of: Arrow
    #: (n, w, w) and (d, m): D^-1 and U.
    alone: Array
    through: Array
    #: (m, m): The Cholesky factor of S.
    L_rest: Array
    #: log|matrix|.
    log_det: float

    @cached_property
    def across(self) -> Array:
        """The columns (d, m) of the rest."""
        flat, of_rest = self.of.blocks.ravel(), _inverse_of(self.L_rest)
        found = np.empty_like(self.through)
        found[self.of.others], found[flat] = of_rest, self.through[flat] @ of_rest
        return found

    @cached_property
    def diagonal(self) -> Array:
        """Its diagonal (d,)."""
        found: Array = (self.across * self.through).sum(axis=1)
        found[self.of.blocks] += np.diagonal(self.alone, axis1=1, axis2=2)
        return found

    def at(self, rows: np.ndarray, columns: np.ndarray) -> Array:
        """Its entries (..., r, c) at rows (..., r) and columns (..., c)."""
        n, w = self.of.blocks.shape
        block, within = np.full(len(self.through), n), np.zeros(len(self.through), dtype=np.int64)
        block[self.of.blocks], within[self.of.blocks] = np.arange(n)[:, None], np.arange(w)
        alone = np.concatenate([self.alone, np.zeros((1, w, w))])  # the rest has none
        rows, columns = rows[..., None], columns[..., None, :]
        same = np.where(block[rows] == block[columns], block[rows], n)
        found: Array = self.across[rows[..., 0]] @ np.swapaxes(self.through[columns[..., 0, :]], -1, -2)
        found += alone[same, within[rows], within[columns]]
        return found

    def between(self, rows: np.ndarray, columns: np.ndarray) -> Array:
        """Those entries, without `at`'s products, where all rows or all columns are of the rest."""
        place = np.full(len(self.through), -1)
        place[self.of.others] = np.arange(len(self.of.others))
        rows, columns = rows[..., None], columns[..., None, :]
        is_column = (place[columns] >= 0).all()
        found: Array = self.across[rows, place[columns]] if is_column else self.across[columns, place[rows]]
        return found

    def times(self, vector: Array) -> Array:
        """Its product (d,) with a vector."""
        blocks = self.of.blocks
        found: Array = self.across @ (self.through.T @ vector)
        found[blocks] += (self.alone @ vector[blocks][:, :, None])[:, :, 0]
        return found


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
            J_R, J_t = (0.5 * part.equations * factors).T
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
        for i, direction in zip(*np.nonzero(part.unseen), strict=True):  # what means nothing has no deviation
            column = np.zeros((size, 1))
            column[slots[Unknown(UnknownKind.FRAME, part.free[i])]][direction] = 1.0
            columns.append(column)
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
            variance = item.paths.known.sum() * item.paths.velocity_variance.reshape(2, 3).sum(axis=1)
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
