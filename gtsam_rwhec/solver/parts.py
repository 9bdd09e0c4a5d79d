"""The parts of a problem that are solved separately: their frames, which side is eliminated first, and their gauge."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import numpy as np

from gtsam_rwhec.errors import FrameError, PoseError, PriorError, ScaleError, UnderdeterminedError
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.problem.knowledge import Prior, ScaleMode
from gtsam_rwhec.problem.many_measurements import Sorted
from gtsam_rwhec.problem.measurements import Measurements, Pair
from gtsam_rwhec.problem.moment_stack import MomentStack
from gtsam_rwhec.problem.moments import Gauge
from gtsam_rwhec.problem.problem import Problem
from gtsam_rwhec.solver.directed_pairs import DirectedPair, directed_pairs

#: Pairs with more measurements are evaluated one by one.
SMALL = 256


@dataclass(frozen=True)
class Shared:
    """Measurements of many pairs, and which pair of the part each of them is (P,): -1 for none."""

    many: Sorted
    pair: np.ndarray

    def of(self, begin: int, end: int) -> Shared | None:
        """The measurements of pairs ``begin`` up to ``end``, numbered from ``begin``; None if there are none."""
        inside = (self.pair >= begin) & (self.pair < end)
        return Shared(self.many, np.where(inside, self.pair - begin, -1)) if inside.any() else None


@dataclass(frozen=True)
class Given:
    """Raw measurements by the index of their pair, fixed poses (4, 4) and priors, about the user's own origin."""

    batches: list[tuple[int, Measurements]]  #: of pairs that do not weigh by direction, in ascending order of the pairs
    shared: list[Shared]  #: of pairs that were added many at once
    fixed: dict[str, Array]
    priors: dict[str, list[Prior]]

    @staticmethod
    def of(problem: Problem, pairs: tuple[Pair, ...], names: frozenset[str]) -> Given | None:
        """What a problem holds of the pairs and frames; None where its raw measurements were not kept."""
        if not problem.has_measurements:
            return None
        by_direction = problem.directed
        batches: list[tuple[int, Measurements]] = []
        shared: dict[int, Shared] = {}
        for e, pair in enumerate(pairs):
            if pair in by_direction:
                continue
            for batch in problem.stored(pair):
                if batch.count > SMALL or len(batch.many.pairs) == 1:
                    batches.append((e, batch.measurements))
                else:
                    many = batch.many
                    if id(many) not in shared:
                        shared[id(many)] = Shared(many, np.full(len(many.pairs), -1))
                    shared[id(many)].pair[batch.index] = e
        return Given(
            batches,
            list(shared.values()),
            {name: T for name, T in problem.fixed.items() if name in names},
            {name: priors for name, priors in problem.priors.items() if name in names},
        )


#: "direct" is Problem 3 of the RWHEC paper, A X = Y B; "inverse" is the inverse equation, B X^-1 = Y^-1 A, which a
#: scale for each target needs (design fact 7).
Kind = Literal["direct", "inverse"]
#: A gauge that moves by more than this many times the spread of the translations loses the digits of that number's
#: square, four or more of 16.
FAR = 100.0


@dataclass(frozen=True)
class Part:
    """One connected part of a problem, about its own gauge."""

    free: tuple[str, ...]  #: the frames whose poses are unknown, targets first: the order of all their numbers
    targets: tuple[str, ...]  #: all of the part, fixed ones too
    sensors: tuple[str, ...]  #: all of the part, fixed ones too
    pairs: tuple[Pair, ...]  #: the pairs that join the frames
    moments: MomentStack  #: of the pairs in their order, about ``gauge``
    fixed: dict[str, Array]  #: known poses (4, 4), about ``gauge``
    priors: dict[str, list[Prior]]  #: about ``gauge``
    fixed_scales: dict[str, float]  #: known scales of targets, and of sensors with motions of their own
    gauge: Gauge  #: the reference points of moments and poses
    kind: Kind  #: which equation's residuals the form has
    scale: ScaleMode
    is_relative: bool  #: whether all weights are 1, so that costs have no statistical meaning
    given: Given | None  #: the raw measurements, fixed frames and priors; None where measurements were not kept
    directed: tuple[DirectedPair, ...] = ()  #: the pairs that weigh by direction, in ascending order

    @property
    def names(self) -> tuple[str, ...]:
        """All frames of the part."""
        return self.targets + self.sensors

    def directed_at(self, at: slice) -> Iterator[tuple[int, DirectedPair]]:
        """Those of some pairs that weigh by direction, with their places among these."""
        return ((each.e - at.start, each) for each in self.directed if at.start <= each.e < at.stop)

    def centres(self, e: int) -> tuple[Array, Array]:
        """The gauge's points (a, c) of a pair: a motion has both ends in the sensor's carrier."""
        a = self.gauge.sensor_carrier
        return a, a if self.pairs[e].is_motion else self.gauge.target_carrier

    @cached_property
    def equations(self) -> Array:
        """(E, 2): how many equations of rotation and of translation a pair gives."""
        result = np.repeat(3.0 * self.moments.count[:, None], 2, axis=1)
        for each in self.directed:
            result[each.e] = each.equations
        return result

    @cached_property
    def unseen(self) -> np.ndarray:
        """(n, 6): which directions of the free frames mean nothing."""
        result = np.zeros((len(self.free), 6), dtype=bool)
        for each in self.directed:
            if each.unseen.any():
                result[self.ends[each.e, 0]] = each.unseen
        return result

    @cached_property
    def ends(self) -> np.ndarray:
        """(E, 2): each pair's target and sensor, by their places in ``free``; fixed frames, as in ``fixed``, follow."""
        place = {name: i for i, name in enumerate((*self.free, *self.fixed))}
        flat = (place[name] for pair in self.pairs for name in pair)
        return np.fromiter(flat, int, 2 * len(self.pairs)).reshape(-1, 2)

    @cached_property
    def _of_target_carrier(self) -> frozenset[str]:
        return frozenset(self.targets)

    @property
    def number_of_measurements(self) -> int:
        """The sum over all pairs."""
        return int(self.moments.count.sum())

    @cached_property
    def scale_owners(self) -> tuple[str, ...]:
        """Frames with an unknown scale of their own: targets, and sensors with motions of their own."""
        if self.scale != "per_target":
            return ()
        return tuple(dict.fromkeys(t for t, _ in self.pairs if t not in self.fixed_scales))

    @cached_property
    def owns_scale(self) -> np.ndarray:
        """(E,): whether a pair's scale is its own variable."""
        owners = frozenset(self.scale_owners)
        return np.array([target in owners for target, _ in self.pairs], dtype=bool)

    @cached_property
    def known_scales(self) -> Array:
        """(E,): the scale of each pair where it is known, else 1."""
        return np.array([self.fixed_scales.get(target, 1.0) for target, _ in self.pairs], dtype=float)

    @property
    def is_scaled(self) -> bool:
        """Whether the form's translations are alpha times those of the frames."""
        return self.kind == "direct" and self.scale == "shared"

    @property
    def number_of_unknowns(self) -> int:
        """Six for each free frame, and one for each unknown scale."""
        return 6 * len(self.free) - int(self.unseen.sum()) + (self.scale == "shared") + len(self.scale_owners)

    def frame_shift(self, name: str) -> Array:
        """The translation that the gauge has subtracted from a frame's, in metres."""
        return self.gauge.target_carrier if name in self._of_target_carrier else self.gauge.sensor_carrier


def parts_of(problem: Problem, about: Mapping[str, Array] | None = None, scale: float = 1.0) -> list[Part]:
    """Split a problem into connected parts, and check the problem as a whole.

    ``about`` has poses (4, 4) of the frames, and ``scale`` the shared scale there, at which measurements that weigh by
    direction have their directions; left out, their translations have mean weights, except on frames that are fixed.
    A scale that all targets share joins all frames to one part.
    Raises `CountError` without measurements; `FrameError` for a fixed frame, prior or scale of a frame that no
    measurement mentions; `UnderdeterminedError` for fewer equations than unknowns in a part.
    """
    problem.require_pairs()
    frames = problem.targets + problem.sensors
    order = {name: i for i, name in enumerate(frames)}
    for what, names in (("fixed", problem.fixed), ("given a prior", problem.priors), ("scaled", problem.fixed_scales)):
        for name in names:
            if name not in order:
                raise FrameError(f"{name!r} is {what}, but no measurement mentions it; there are {', '.join(frames)}")
    components = connected_components(problem.pairs)
    if problem.scale == "shared":
        components = [[name for component in components for name in component]]
    where = {name: i for i, component in enumerate(components) for name in component}
    pairs: list[list[Pair]] = [[] for _ in components]
    for pair in problem.pairs:
        pairs[where[pair.sensor]].append(pair)
    return [
        _part(problem, sorted(component, key=order.__getitem__), tuple(of_component), about or {}, scale)
        for component, of_component in zip(components, pairs, strict=True)
    ]


def connected_components(pairs: tuple[Pair, ...]) -> list[list[str]]:
    """The frames of each connected part of the graph, in order of first appearance."""
    members: dict[str, list[str]] = {}
    for pair in pairs:
        few, many = sorted((members.setdefault(name, [name]) for name in pair), key=len)
        if few is not many:
            many += few
            members |= dict.fromkeys(few, many)
    components: dict[int, list[str]] = {}
    for name, component in members.items():
        components.setdefault(id(component), []).append(name)
    return list(components.values())


def _part(
    problem: Problem, names: list[str], pairs: tuple[Pair, ...], about: Mapping[str, Array], scale: float
) -> Part:
    """A part of these frames, targets before sensors, as the problem orders them."""
    members, seen = frozenset(names), {pair.target for pair in pairs if not pair.is_motion}
    targets = tuple(name for name in names if name in seen)
    sensors = tuple(name for name in names if name not in seen)
    gauge, moments = _centred(problem, pairs)
    priors = {name: problem.priors[name] for name in problem.priors if name in members}
    directed = directed_pairs(problem, pairs, about, scale)
    is_inverse = problem.scale == "per_target" or (
        problem.scale == "shared" and any(p.sigma is not None for beliefs in priors.values() for p in beliefs)
    )
    if directed and is_inverse:
        raise ScaleError(
            f"{', '.join(names)}: measurements that weigh by direction ({pairs[directed[0].e]}) take no prior of a "
            "translation beside an unknown scale; give the scale, or fix the frame"
        )
    shift = {name: gauge.target_carrier for name in targets} | {name: gauge.sensor_carrier for name in sensors}
    part = Part(
        free=tuple(name for name in targets + sensors if name not in problem.fixed),
        targets=targets,
        sensors=sensors,
        pairs=pairs,
        moments=moments,
        fixed={name: _moved(T, shift[name]) for name, T in problem.fixed.items() if name in members},
        priors={
            name: [Prior(_moved(p.transform, shift[name]), p.sigma, p.kappa) for p in beliefs]
            for name, beliefs in priors.items()
        },
        fixed_scales={name: s for name, s in problem.fixed_scales.items() if name in members},
        gauge=gauge,
        kind="inverse" if is_inverse else "direct",
        scale=problem.scale,
        is_relative=problem.is_relative,
        given=Given.of(problem, pairs, members),
        directed=directed,
    )
    _check(part)
    return part


def _centred(problem: Problem, pairs: tuple[Pair, ...]) -> tuple[Gauge, MomentStack]:
    """A part's gauge, and its moments about this gauge (design fact 9).

    The formula that moves moments is exact, but a move far beyond the spread of the translations loses digits. This
    happens when the first measurements were nearly one pose. Then the raw measurements, if kept, are summed again.
    """
    moments = problem.moment_stack(pairs)
    a, c = moments.best_shift()
    gauge, centred = problem.gauge.moved_by(a, c), moments.shifted(a, c)
    far = float(np.hypot(np.linalg.norm(a), np.linalg.norm(c)))
    if far > FAR * centred.spread() and problem.has_measurements:
        raw = (Sorted.of(pair, problem.measurements(*pair)) for pair in pairs)
        centred = MomentStack.joined([each.moments(gauge, with_R_B=True) for each in raw])
    return gauge, centred


def _moved(T: Array, origin: Array) -> Array:
    moved = T.copy()
    moved[:3, 3] -= origin
    return moved


def _check(part: Part) -> None:
    equations = int(part.equations.sum())
    beliefs = [p for priors in part.priors.values() for p in priors]
    equations += sum(3 * (p.sigma is not None) + 3 * (p.kappa is not None) for p in beliefs)
    if equations < part.number_of_unknowns:
        raise UnderdeterminedError(
            f"{', '.join(part.names)}: {part.number_of_measurements} measurements give {equations} equations for "
            f"{part.number_of_unknowns} unknowns; measure more, or fix a frame"
        )
    for name in part.scale_owners:
        if name in part.fixed:
            raise PriorError(
                f"the pose of {name} is fixed and its scale is unknown, which the certified form cannot hold; "
                f"fix the scale too (fix_scale), or give the pose as a tight prior (add_prior)"
            )
    measured = {target for target, _ in part.pairs} if part.fixed_scales else set()
    for name in part.fixed_scales:
        if name not in measured:
            raise ScaleError(f"the scale of {name} is fixed, but nothing measures {name}'s size")
    bad = np.flatnonzero(~part.moments.is_finite())
    if bad.size:
        raise PoseError(
            f"the translations of {part.pairs[bad[0]]} are so large that their squares overflow; are they in metres?"
        )
