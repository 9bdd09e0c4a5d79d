"""A lower bound on the cost of every answer, from any multipliers, that is rigorous in floating point.

Let L(y) = J(y) - sum lambda_k c_k(y), where c_k(y) = 0 are the constraints of rotations. L is quadratic in all
variables, translations included. About any point x, with g half its gradient and Z half its second derivative::

    J(y) = L(y) = L(x) + 2 g'd + d'Z d,      d = y - x

L(x) and g come from the raw measurements, where nothing cancels (`measured_form`). Only Z comes from the moments; its
rounding only has to be small against its eigenvalues. If Z >= diag(m) with m > 0, then for any vector v, with rho = g -
Z v: 2 g'd + d'Z d >= -(2 g - Z v)'v - sum rho^2 / m. With v near Z^-1 g the bound is almost tight.

**Null vectors.** Where the measurements leave directions V free, Z is singular. For each, one variable is held: d =
V a + z, where z is zero at the held variables and a is d there. Then Z has to be definite for z only, and ::

    L(y) >= L(x) + 2 (V'g)'a + a'(V'Z V) a - |g + Z V a|^2 in the norm of the inverse of Z

V'ZV, V'g and Z V are computed from the raw measurements' residuals along V, which are almost zero. Held entries of
rotations have |a| <= 2; held translations and scales are limited by a `Region`. With an unknown scale nothing couples
to h, and x itself is a null vector.

**Rotations in floating point** satisfy their constraints up to rounding only. The bound covers those too.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.geometry.rounding import UNIT, gamma
from gtsam_rwhec.solver.answers import Answer, Evaluation
from gtsam_rwhec.solver.block_matrix import BlockFactor
from gtsam_rwhec.solver.curvature import Curvature
from gtsam_rwhec.solver.null_vectors import NullVectors, free_vectors, point_as_null_vector, stationary_along
from gtsam_rwhec.solver.part_form import PartForm
from gtsam_rwhec.solver.region import AT_LEAST, LARGER, Region, half_widths, smallest_region
from gtsam_rwhec.solver.rotations import constraint_values, multiplier_blocks

#: Margins of definiteness as fractions of the form's diagonal. The largest proven margin gives the smallest loss.
ROOMS = (1e-5, 1e-7, 1e-9, 1e-11, 1e-13)
#: A solution with a proof's factor is refined at most ``IMPROVEMENTS`` times, until its error is ``ENOUGH`` of the
#: loss.
IMPROVEMENTS = 6
ENOUGH = 1e-6
#: A loss below this part of the value needs no solution at all.
NEXT_TO_NOTHING = 1e-10


@dataclass(frozen=True)
class Room:
    """A margin (13 n + 1,) by which Z is proven to be definite, and the value that losses are compared with."""

    Z: Curvature
    margin: Array
    value: float
    proof: BlockFactor | None  #: the factor of nearly Z - margin, where it was kept

    @staticmethod
    def of(Z: Curvature, margin: Array, value: float) -> Room | None:
        """The room, if it is proven."""
        if Z.has_large_factor:
            return Room(Z, margin, value, None) if Z.is_proven_to_exceed(margin) else None
        proof = Z.proof_that_it_exceeds(margin)
        return None if proof is None else Room(Z, margin, value, proof)

    @staticmethod
    def largest(Z: Curvature, scale: Array, value: float) -> Room | None:
        """The largest room that is proven; the margins tried are fractions of a diagonal ``scale`` (13 n + 1,)."""
        for part in ROOMS:
            proven = Room.of(Z, np.maximum(part * scale, 1e-290), value)
            if proven is not None:
                return proven
        return Room.of(Z, 0.25 * Z.allowance(scale), value)

    @cached_property
    def _factor(self) -> BlockFactor | None:
        return self.proof or self.Z.proof_that_it_exceeds(self.margin)

    def solved(self, h: Array, held: np.ndarray) -> Array:
        """An approximation of Z^-1 h: the factor's solution, refined where the margin makes it poor; zero at ``held``.

        If no factor was kept and the zero vector loses almost nothing, the zero vector is returned.
        """
        v, rest, size = np.zeros_like(h), h, np.inf
        if self.proof is None and float((h**2 / self.margin).sum()) <= NEXT_TO_NOTHING * abs(self.value):
            return v
        factor = self._factor
        if factor is None:  # it was there before
            return v
        for _ in range(IMPROVEMENTS):
            better = v + factor.solve_vector(rest)
            better[held] = 0.0
            after = h - self.Z.times(better)
            after[held] = 0.0
            after_size = float((after**2 / self.margin).sum())
            if not after_size < size:
                break
            v, rest, size = better, after, after_size
            if size <= ENOUGH * abs(float(h @ v)):
                break
        return v


def loss_along(nulls: NullVectors, root: float, of_nulls: Array, width: Array) -> float:
    """An upper bound on -min of 2 (V'g)'a + a'(V'ZV)a - (root + sum |a_k| of_nulls_k)^2 + root^2, over |a| <= width.

    In a direction in which V'ZV is surely positive no limit is needed.
    """
    k = len(width)
    if k == 0:
        return 0.0
    # (sum |a_k| r_k)^2 <= k sum a_k^2 r_k^2. In units of the limits, so that directions compare.
    curved = nulls.VZV - np.diag(k * of_nulls**2)
    curved = 0.5 * (curved + curved.T) * width[:, None] * width
    slope = (np.abs(nulls.Vg) + nulls.Vg_error + root * of_nulls) * width
    if not (np.isfinite(curved).all() and np.isfinite(slope).all()):
        return np.inf
    values, vectors = np.linalg.eigh(curved)
    unsure = float((nulls.VZV_error * width[:, None] * width).sum()) + 1e-13 * k * float(np.abs(curved).sum())
    loss = 0.0
    for value, vector in zip(values - unsure, vectors.T, strict=True):
        h = float(np.abs(vector) @ slope)
        reach = float(np.abs(vector).sum())
        box = 2.0 * h * reach + max(-float(value), 0.0) * reach**2
        loss += min(box, h * h / float(value)) if value > 0.0 else box
    return loss * (1.0 + 1e-9)


def root_of_loss(room: Room, h: Array, h_error: Array, held: np.ndarray) -> tuple[float, float]:
    """The root of an upper bound on -min 2 h'z + z'Z z, over z whose ``held`` entries are zero.

    Returns two values: with the error of h, and without it.
    """
    h, h_error = h.copy(), h_error.copy()
    h[held], h_error[held] = 0.0, 0.0
    v = room.solved(h, held)
    Zv, error = room.Z.times(v), room.Z.rounding_of_product(v)
    rest = h - Zv
    rest[held], error[held] = 0.0, 0.0
    taken = float((h + rest) @ v) + gamma(len(v) + 8) * float((np.abs(h) + np.abs(rest)) @ np.abs(v))
    taken += float(error @ np.abs(v))
    rho = np.abs(rest) * (1.0 + 4.0 * UNIT) + error
    square = max(taken, 0.0) + float((rho**2 / room.margin).sum())
    root, of_error = np.sqrt(square), np.sqrt(float((h_error**2 / room.margin).sum()))
    return float(root + of_error) * (1.0 + 1e-9), float(root) * (1.0 + 1e-9)


#: For rotations in floating point, each entry of R'R - I and each residual of the other constraints is at most this.
ROTATION_IN_DOUBLES = 1e-15
#: The factor from one slack to the next one tried.
MORE_SLACK = 3.0
#: With a loss below this fraction of the value, nothing else is tried.
NEGLIGIBLE = 1e-9
#: With a loss above this fraction of the value, other null vectors are tried.
OPEN = 1e-6


@dataclass(frozen=True)
class Bound:
    """A rigorous lower bound, and what was proven about Z for it; ``Bound()`` claims nothing."""

    lower_bound: float = -np.inf  #: no answer (of the region) costs less
    value: float = -np.inf  #: the smallest value of L without any allowance: the bound in exact arithmetic
    definite: bool = False  #: whether Z is proven positive definite (but for x, for an unknown scale)
    semidefinite: bool = False  #: whether Z is proven positive semidefinite up to rounding
    eigenvalue: float = -np.inf  #: a lower bound on Z's smallest eigenvalue
    direction: Array | None = None  #: (9 n,): rotations along which Z is negative, for a better start
    region: Region | None = None  #: where the bound holds; None: for all answers
    #: (13 n + 1,): a step along free directions, in the form's variables, that lowers the cost by more than is enough.
    step: Array | None = None

    def at_most(self, cost: float) -> Bound:
        """The bound, limited to the range from 0 (J is a sum of squares) to the cost of a known answer."""
        lower = min(self.lower_bound, cost)
        if np.isfinite(lower) and lower <= 0.0:
            return replace(self, lower_bound=0.0, region=None)
        return replace(self, lower_bound=lower)


def lower_bound(
    form: PartForm,
    evaluation: Evaluation,
    multipliers: Array,
    *,
    enough: float = 0.0,
    of_scale: float = 0.0,
    contains: Answer | None = None,
) -> Bound:
    """The bound from multipliers (n, 20) at an evaluated point. It is true for any, and tight for optimal ones.

    ``enough`` is a loss that does not matter; a region is as large as it allows, and has the answer ``contains`` in it.
    ``of_scale`` is the multiplier of alpha >= 0.
    """
    if not (np.isfinite(multipliers).all() and np.isfinite(evaluation.cost) and np.isfinite(evaluation.gradient).all()):
        return Bound()  # a solver failed, or the answer is no answer
    lagrangian = _Lagrangian.of(form, evaluation, multipliers, of_scale, contains)
    bound = lagrangian.definite() or lagrangian.semidefinite(enough) or lagrangian.indefinite(enough)
    return bound if np.isfinite(bound.lower_bound) else Bound(value=lagrangian.value, direction=bound.direction)


@dataclass(frozen=True)
class _Lagrangian:
    """L at the point x: its value and half its gradient, with bounds on their errors, and Z."""

    form: PartForm
    evaluation: Evaluation
    multipliers: Array
    value: float
    value_error: float
    g: Array
    g_error: Array
    Z: Curvature
    is_homogeneous: bool
    of_scale: float
    contains: Answer | None

    @staticmethod
    def of(
        form: PartForm, evaluation: Evaluation, multipliers: Array, of_scale: float, contains: Answer | None
    ) -> _Lagrangian:
        point = evaluation.point
        n = len(multipliers)
        constraints = constraint_values(point.rotations)
        linear = of_scale * point.alpha
        value = evaluation.cost - float((multipliers * constraints).sum()) - linear
        value_error = evaluation.cost_error + gamma(20 * n + 8) * float(np.abs(multipliers * constraints).sum())
        value_error += gamma(8) * (abs(evaluation.cost) + abs(linear) + abs(value))
        Lambda, size = multiplier_blocks(multipliers)
        r = np.concatenate([point.numbers[:, 4:], np.ones((n, 1))], axis=1)
        g, g_error = evaluation.gradient.copy(), evaluation.gradient_error.copy()
        of_numbers, of_errors = g[:-1].reshape(n, 13), g_error[:-1].reshape(n, 13)
        of_numbers[:, 4:] -= np.einsum("nij,nj->ni", Lambda[:, :9], r)
        of_errors[:, 4:] += gamma(36) * np.einsum("nij,nj->ni", size[:, :9], np.abs(r))
        g[-1] -= 0.5 * of_scale
        g_error += gamma(2) * np.abs(g)
        is_homogeneous = n > 0 and not (form.curvature.is_coupled_to_h or multipliers[:, 11:].any() or of_scale)
        Z = form.curvature.less(multipliers)
        return _Lagrangian(
            form, evaluation, multipliers, value, value_error, g, g_error, Z, is_homogeneous, of_scale, contains
        )

    # -- three cases --------------------------------------------------------------------------------------------

    def definite(self) -> Bound | None:
        """Z is positive definite; if nothing couples to h, then except along x."""
        if self.is_homogeneous:
            return self._definite_but_for_the_point()
        room = self._room(self.Z)
        return None if room is None else self._bound_of_definite(NullVectors.none(self.Z.size), room)

    def _bound_of_definite(self, nulls: NullVectors, room: Room) -> Bound:
        return Bound(
            *self._lower(nulls, room, None), definite=True, semidefinite=True, eigenvalue=float(room.margin.min())
        )

    def _definite_but_for_the_point(self) -> Bound | None:
        """The better of two bounds: from the multipliers, and from those that make the gradient vanish along x."""
        nulls = self._point()
        if nulls is None:
            return None
        bounds = []
        for each in (self._with(stationary_along(nulls.V, nulls.Vg, self.evaluation, self.multipliers)), self):
            of_each = each._point()
            room = None if of_each is None else each._room(each.Z.with_held(of_each.held))
            if of_each is None or room is None:
                continue
            bounds.append(each._bound_of_definite(of_each, room))
            if self.value - bounds[-1].lower_bound <= NEGLIGIBLE * abs(self.value):
                break
        return max(bounds, key=lambda bound: bound.lower_bound, default=None)

    def _point(self) -> NullVectors | None:
        return point_as_null_vector(
            self.evaluation, self.multipliers, self.value, self.value_error, self.g, self.g_error
        )

    def semidefinite(self, enough: float) -> Bound | None:
        """Z is positive semidefinite up to rounding: its null vectors are taken out."""
        bounds = []
        for by_rounding in (True, False):
            found = free_vectors(
                self.form, self.evaluation, self.multipliers, self.Z, self.of_scale, by_rounding=by_rounding
            )
            if found is None:
                continue
            nulls, multipliers = found
            better = self._with(multipliers)
            room = better._room(better.Z.with_held(nulls.held))
            if room is None:
                continue
            lower, value, region = better._over_region(nulls, room, enough)
            step = self._step_along(nulls, enough)
            bounds.append(Bound(lower, value, False, True, -float(room.margin.min()), None, region, step))
            if self.value - lower <= OPEN * abs(self.value) + enough:
                break
        return max(bounds, key=lambda bound: bound.lower_bound, default=None)

    def indefinite(self, enough: float) -> Bound:
        """Z has a negative eigenvalue: rotations are limited, so a slack on their entries costs a limited amount."""
        n = len(self.multipliers)
        Lambda = multiplier_blocks(self.multipliers)[0][:, :9, :9]
        smallest, direction = self.form.form.smallest_eigenpair(Lambda) if n else (0.0, np.zeros(0))
        slack = max(-1.01 * smallest, 4.0 * UNIT * self.form.form.magnitude)
        limit = 1e3 * self.form.form.magnitude
        # The first of slack, 3 slack, 9 slack, ... that is proven: by doubling of the exponent, then by halving.
        last = math.ceil(math.log(limit / slack, MORE_SLACK)) - 1 if 0.0 < slack < limit else -1
        failed, exponent, best = -1, 0, None
        while best is None and failed < last:
            exponent = min(2 * failed + 1, last) if failed >= 0 else 0
            best = self._with_slack(slack * MORE_SLACK**exponent, direction, enough)
            failed = failed if best else exponent
        while best is not None and exponent - failed > 1:
            middle = (failed + exponent) // 2
            smaller = self._with_slack(slack * MORE_SLACK**middle, direction, enough)
            best, exponent, failed = (smaller, middle, failed) if smaller else (best, exponent, middle)
        return best or Bound(value=self.value, direction=direction)

    def _with_slack(self, slack: float, direction: Array, enough: float) -> Bound | None:
        """The bound with slack on the entries of rotations; None where Z is not proven to be definite with it."""
        rotation = self.Z.is_rotation
        # J >= L with slack on Z, less what the slack can add: entries of rotations are at most 1.
        # The sum with the diagonal rounds, too.
        added = slack * (1.0 + 1e-9) + 4.0 * UNIT * np.abs(self.Z.diagonal)[:-1].reshape(-1, 13)[:, 4:]
        loss = float((added * (1.0 + np.abs(self.evaluation.point.numbers[:, 4:])) ** 2).sum()) * (1.0 + 1e-9)
        relaxed = replace(self, Z=self.Z.plus(slack * rotation), value=self.value - loss)
        nulls = NullVectors.none(self.Z.size)
        room = relaxed._room(relaxed.Z)
        if room is None:
            found = free_vectors(self.form, self.evaluation, self.multipliers, relaxed.Z, self.of_scale, slack)
            if found is not None:
                nulls, multipliers = found
                better = self._with(multipliers)
                relaxed = replace(better, Z=better.Z.plus(slack * rotation), value=better.value - loss)
                room = relaxed._room(relaxed.Z.with_held(nulls.held))
        if room is None:
            return None
        lower, _, region = relaxed._over_region(nulls, room, enough)
        return Bound(lower, self.value, False, False, -slack, direction, region)

    def _with(self, multipliers: Array) -> _Lagrangian:
        """The same point with other multipliers."""
        return _Lagrangian.of(self.form, self.evaluation, multipliers, self.of_scale, self.contains)

    # -- parts of a proof ---------------------------------------------------------------------------------------

    def _room(self, Z: Curvature) -> Room | None:
        """A margin by which Z is proven to be definite; None where it is not proven."""
        return Room.largest(Z, np.abs(self.form.curvature.diagonal), self.value)

    def _over_region(self, nulls: NullVectors, room: Room, enough: float) -> tuple[float, float, Region | None]:
        """`_lower` over the largest region that costs it at most ``enough``; without a region if none is needed."""
        if self.Z.is_rotation[nulls.held].all():
            return *self._lower(nulls, room, None), None
        smallest = smallest_region(self.form.part, self.evaluation.point, self.contains)
        best = self._lower(nulls, room, smallest)
        for times in LARGER:
            region = smallest.larger(times)
            larger = self._lower(nulls, room, region)
            if best[0] - larger[0] <= enough:
                return *larger, region
        return *best, smallest

    def _lower(self, nulls: NullVectors, room: Room, region: Region | None) -> tuple[float, float]:
        """The lower bound, rounded down; and the same without any allowance for rounding: that of exact arithmetic."""
        width = np.zeros(0)
        if len(nulls.held):
            width = half_widths(self.form.part, self.evaluation.point, region or Region(0.0, 0.0))[nulls.held]
        roots = np.array(root_of_loss(room, self.g, self.g_error, nulls.held))
        each = [root_of_loss(room, nulls.ZV[:, k], nulls.ZV_error[:, k], nulls.held) for k in range(len(nulls.held))]
        of_nulls = np.array(each).reshape(-1, 2).T
        loss = [
            root * root + loss_along(own, root, of_own, width)
            for root, of_own, own in zip(roots, of_nulls, (nulls, nulls.without_errors()), strict=True)
        ]
        lower, value = self.value - np.array([self.value_error, 0.0]) - np.array(loss) * (1.0 + 1e-9)
        # |L - J| has this bound at rotations in floating point.
        slack = ROTATION_IN_DOUBLES * float(np.abs(self.multipliers).sum()) * (1.0 + 1e-9)
        lower = max(lower - slack, self._less_rounding_of_rotations(lower))
        return float(np.nextafter(lower, -np.inf)), float(value)

    def _step_along(self, nulls: NullVectors, enough: float) -> Array | None:
        """The step along free translations and scales to the lowest value, where the cost surely rises along them.

        None if it gains no more than is enough.
        """
        moving = ~self.Z.is_rotation[nulls.held]
        if not moving.any():
            return None
        smallest = smallest_region(self.form.part, self.evaluation.point, None)
        reach = half_widths(self.form.part, self.evaluation.point, smallest)[nulls.held[moving]] / AT_LEAST
        VZV = nulls.VZV[np.ix_(moving, moving)] * reach[:, None] * reach
        values, vectors = np.linalg.eigh(0.5 * (VZV + VZV.T))
        unsure = float((nulls.VZV_error[np.ix_(moving, moving)] * reach[:, None] * reach).sum())
        surely = values > max(2.0 * unsure, enough)
        slope = vectors.T @ (nulls.Vg[moving] * reach)
        if float((slope[surely] ** 2 / values[surely]).sum()) <= enough:
            return None
        step: Array = -nulls.V[:, moving] @ (reach * (vectors[:, surely] @ (slope[surely] / values[surely])))
        return step

    def _less_rounding_of_rotations(self, lower: float) -> float:
        """The bound for rotations in floating point, from that for exact ones: the root of J is a norm of residuals."""
        if lower <= 0.0:
            return -np.inf
        diagonal = self.form.curvature.diagonal + self.form.curvature.rounding
        change = ROTATION_IN_DOUBLES * float(np.sqrt(np.maximum(diagonal[self.Z.is_rotation], 0.0)).sum())
        root = np.sqrt(lower) * (1.0 - 4.0 * UNIT) - change
        return float(root * root) * (1.0 - 4.0 * UNIT) if root > 0.0 else -np.inf
