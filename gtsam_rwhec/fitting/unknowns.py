"""The unknowns of a refinement as records, and their names as users and files write them."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from enum import Enum
from typing import NamedTuple

import gtsam
import numpy as np

from gtsam_rwhec.errors import FrameError
from gtsam_rwhec.files.terminal_text import brief
from gtsam_rwhec.problem.measurements import Pair
from gtsam_rwhec.problem.problem import Problem
from gtsam_rwhec.solver.solution import Solution


class UnknownKind(Enum):
    """The kind of an unknown; the value is its word in files and names."""

    FRAME = "frame"
    SCALE = "scale"
    TIME_OFFSET = "time_offset"
    #: Of a clock, by how much it is too slow; a nuisance, which no result has.
    CLOCK_RATE = "clock_rate"
    #: Of a camera: as many parameters as its lens has.
    INTRINSICS = "intrinsics"
    #: Of a board: what is free of its warp.
    SHAPE = "shape"


class Unknown(NamedTuple):
    """The pose of a frame, a scale, the time offset of a sensor's clock, a camera's intrinsics, or a board's shape.

    ``owner`` is the frame, target or sensor that the unknown belongs to; empty for one scale that all targets share.
    """

    kind: UnknownKind
    owner: str = ""

    @staticmethod
    def of(name: object) -> Unknown:
        """The unknown of a name: "cam_0", "scale", "scale:tag_0", "time_offset:cam_0", "intrinsics:cam_0", ...

        Raises FrameError for what is no name.
        """
        if isinstance(name, Unknown):
            return name
        if not isinstance(name, str):
            raise FrameError(f"{brief(name)} is not a name; give the name of a frame, a scale or a time offset")
        if name == UnknownKind.SCALE.value:
            return Unknown(UnknownKind.SCALE)
        word, separator, owner = name.partition(":")
        for kind in UnknownKind:
            if separator and word == kind.value and kind is not UnknownKind.FRAME:
                return Unknown(kind, owner)
        return Unknown(UnknownKind.FRAME, name)

    def __str__(self) -> str:
        """The name that ``of`` reads."""
        if self.kind is UnknownKind.FRAME:
            return self.owner
        return f"{self.kind.value}:{self.owner}" if self.owner else self.kind.value

    @property
    def dimension(self) -> int:
        """The number of parameters: 6 of a frame, [omega, v]; 1 of a scale or an offset. A lens says its own."""
        return 6 if self.kind is UnknownKind.FRAME else 1


def slots_of(unknowns: Iterable[Unknown]) -> dict[Unknown, slice]:
    """The slice of each unknown's parameters in the vector of all parameters."""
    slots, first = {}, 0
    for unknown in unknowns:
        slots[unknown] = slice(first, first + unknown.dimension)
        first += unknown.dimension
    return slots


def rows_of(slots: Mapping[Unknown, slice], unknowns: Iterable[Unknown]) -> np.ndarray:
    """The indices (m,) of the parameters of some unknowns, in the order given."""
    return np.array(
        [row for unknown in unknowns for row in range(slots[unknown].start, slots[unknown].stop)], dtype=np.int64
    )


@dataclass(frozen=True)
class State:
    """An estimate: poses by frame, scales (measured / true length), time offsets in seconds and rates by sensor."""

    X: dict[str, gtsam.Pose3]
    Y: dict[str, gtsam.Pose3]
    scales: dict[Unknown, float]
    offsets_s: dict[str, float]
    rates: dict[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class Variables:
    """The variables' keys in the graph."""

    #: Pose3 variables: X = T_targetcarrier_target, Y = T_sensorcarrier_sensor.
    targets: dict[str, int]
    sensors: dict[str, int]
    #: 1-vectors: one shared scale, or the unknown scales with scale="per_target".
    scales: dict[Unknown, int]
    #: 1-vectors in seconds, by sensor.
    offsets: dict[str, int]
    #: Frames that are known exactly; they are in the graph, but not among the unknowns.
    fixed: frozenset[str]
    #: The scale of a pair's translations; pairs of known scale are absent.
    scale_of_pair: dict[Pair, Unknown]
    #: Sensors whose clock has a rate, which is no variable of a graph; and the stamp (ns) at which its offset holds.
    rates: Mapping[str, int] = field(default_factory=dict)

    @staticmethod
    def of(problem: Problem, time_offsets: tuple[str, ...], rates: Mapping[str, int] | None = None) -> Variables:
        """The variables of a problem, with time offsets of the named sensors, and rates of some of these."""
        for name in problem.targets + problem.sensors:
            if Unknown.of(name).kind is not UnknownKind.FRAME:
                raise FrameError(
                    f"the frame name {name!r} is the name of a scale or a time offset in refinement; rename the frame"
                )
        scale_of_pair: dict[Pair, Unknown] = {}
        if problem.scale != "known":
            scale_of_pair = {
                pair: Unknown(UnknownKind.SCALE, pair.target if problem.scale == "per_target" else "")
                for pair in problem.pairs
                if pair.target not in problem.fixed_scales
            }
        return Variables(
            targets={name: gtsam.symbol("x", i) for i, name in enumerate(problem.targets)},
            sensors={name: gtsam.symbol("y", i) for i, name in enumerate(problem.sensors)},
            scales={scale: gtsam.symbol("s", i) for i, scale in enumerate(dict.fromkeys(scale_of_pair.values()))},
            offsets={name: gtsam.symbol("d", i) for i, name in enumerate(time_offsets)},
            fixed=frozenset(problem.fixed),
            scale_of_pair=scale_of_pair,
            rates=rates or {},
        )

    @property
    def frames(self) -> dict[str, int]:
        """Targets and sensors."""
        return self.targets | self.sensors

    @property
    def keys(self) -> dict[Unknown, int]:
        """Every variable's key, with fixed frames."""
        frames = {Unknown(UnknownKind.FRAME, name): key for name, key in self.frames.items()}
        offsets = {Unknown(UnknownKind.TIME_OFFSET, name): key for name, key in self.offsets.items()}
        return frames | self.scales | offsets

    @property
    def unknowns(self) -> tuple[Unknown, ...]:
        """The unknowns, in the order of ``keys``, and the rates."""
        in_graph = (u for u in self.keys if u.kind is not UnknownKind.FRAME or u.owner not in self.fixed)
        return (*in_graph, *(Unknown(UnknownKind.CLOCK_RATE, name) for name in self.rates))

    def ends(self, pair: Pair) -> tuple[int, int]:
        """Keys of a pair's target and sensor; for motions the sensor's key twice."""
        return self.frames[pair.target], self.frames[pair.sensor]

    def scale_key(self, pair: Pair) -> int | None:
        """Key of the scale of a pair's translations."""
        return self.scales[self.scale_of_pair[pair]] if pair in self.scale_of_pair else None

    def offset_key(self, pair: Pair) -> int | None:
        """Key of the time offset of a pair's sensor."""
        return self.offsets.get(pair.sensor)

    def values(self, state: State) -> gtsam.Values:
        """An estimate as GTSAM's values."""
        values = gtsam.Values()
        for keys, poses in ((self.targets, state.X), (self.sensors, state.Y)):
            for name, key in keys.items():
                values.insert(key, poses[name])
        for scale, key in self.scales.items():
            values.insert(key, np.array([state.scales[scale]]))
        for name, key in self.offsets.items():
            values.insert(key, np.array([state.offsets_s[name]]))
        return values

    def state(self, values: gtsam.Values) -> State:
        """GTSAM's values as an estimate."""
        return State(
            X={name: values.atPose3(key) for name, key in self.targets.items()},
            Y={name: values.atPose3(key) for name, key in self.sensors.items()},
            scales={scale: float(values.atVector(key)[0]) for scale, key in self.scales.items()},
            offsets_s={name: float(values.atVector(key)[0]) for name, key in self.offsets.items()},
        )

    def start(self, solution: Solution) -> State:
        """The certified solution as an estimate."""
        of = solution.scale
        scales = {u: of[u.owner] if isinstance(of, dict) else float(of) for u in self.scales}
        offsets, rates = (dict.fromkeys(each, 0.0) for each in (self.offsets, self.rates))
        return State(dict(solution.X), dict(solution.Y), scales, offsets, rates)


def carrier_key(index: int) -> int:
    """Key of a carrier pose A = T_sensorcarrier_targetcarrier that is a variable."""
    key: int = gtsam.symbol("a", index)
    return key
