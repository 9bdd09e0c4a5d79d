"""What is refined: its keys in the graph, and values in and out of GTSAM."""

from __future__ import annotations

from dataclasses import dataclass

import gtsam
import numpy as np

from gtsam_rwhec.errors import FrameError
from gtsam_rwhec.problem.pairs import Pair
from gtsam_rwhec.problem.problem import Problem
from gtsam_rwhec.refinement.unknowns import Unknown, UnknownKind
from gtsam_rwhec.solving.solution import Solution


@dataclass(frozen=True)
class State:
    """An estimate: poses (4, 4) by frame, scales as they stand, offsets in seconds by sensor."""

    X: dict[str, gtsam.Pose3]
    Y: dict[str, gtsam.Pose3]
    scales: dict[Unknown, float]
    offsets_s: dict[str, float]


@dataclass(frozen=True)
class Variables:
    """The variables' keys in the graph.

    Attributes
    ----------
    targets, sensors : dict of str to int
        Pose3 variables: X = T_targetcarrier_target, Y = T_sensorcarrier_sensor.
    scales : dict of Unknown to int
        1-vectors: one that is shared, or one for each unknown one with scale="per_target".
    offsets : dict of str to int
        1-vectors in seconds, by sensor.
    fixed : frozenset of str
        Frames that are known exactly; in the graph, but not unknown.
    scale_of_pair : dict of Pair to Unknown
        Which scale a pair's translations are multiplied by; pairs of known scale are absent.
    """

    targets: dict[str, int]
    sensors: dict[str, int]
    scales: dict[Unknown, int]
    offsets: dict[str, int]
    fixed: frozenset[str]
    scale_of_pair: dict[Pair, Unknown]

    @staticmethod
    def of(problem: Problem, time_offsets: tuple[str, ...]) -> Variables:
        """Of a problem, with time offsets of the sensors named."""
        for name in problem.targets + problem.sensors:
            if Unknown.of(name).kind is not UnknownKind.FRAME:
                raise FrameError(
                    f"a frame is called {name!r}, which is what refinement calls a scale or a time offset; rename it"
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
        )

    @property
    def frames(self) -> dict[str, int]:
        """Targets and sensors."""
        return self.targets | self.sensors

    @property
    def keys(self) -> dict[Unknown, int]:
        """Every variable's key, those of fixed frames too."""
        frames = {Unknown(UnknownKind.FRAME, name): key for name, key in self.frames.items()}
        offsets = {Unknown(UnknownKind.TIME_OFFSET, name): key for name, key in self.offsets.items()}
        return frames | self.scales | offsets

    @property
    def unknowns(self) -> tuple[Unknown, ...]:
        """Everything that is not known, in the order of ``keys``."""
        return tuple(u for u in self.keys if u.kind is not UnknownKind.FRAME or u.owner not in self.fixed)

    def ends(self, pair: Pair) -> tuple[int, int]:
        """Keys of a pair's target and sensor; of a motion's, twice the sensor's."""
        return self.frames[pair.target], self.frames[pair.sensor]

    def scale_key(self, pair: Pair) -> int | None:
        """Key of the scale of a pair's translations."""
        return self.scales[self.scale_of_pair[pair]] if pair in self.scale_of_pair else None

    def offset_key(self, pair: Pair) -> int | None:
        """Key of the time offset of a pair's sensor."""
        return self.offsets.get(pair.sensor)

    def values(self, state: State) -> gtsam.Values:
        """An estimate as GTSAM's."""
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
        return State(dict(solution.X), dict(solution.Y), scales, dict.fromkeys(self.offsets, 0.0))


def carrier_key(index: int) -> int:
    """Key of a carrier pose A = T_sensorcarrier_targetcarrier, where A's are variables."""
    key: int = gtsam.symbol("a", index)
    return key
