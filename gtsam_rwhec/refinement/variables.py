"""Names of what is refined, their keys in the graph, and values in and out of GTSAM."""

from __future__ import annotations

from dataclasses import dataclass

import gtsam
import numpy as np

from gtsam_rwhec.errors import FrameError
from gtsam_rwhec.problem.pairs import Pair
from gtsam_rwhec.problem.problem import Problem
from gtsam_rwhec.solving.solution import Solution


@dataclass(frozen=True)
class State:
    """An estimate: poses (4, 4) and scales as they stand, offsets in seconds."""

    X: dict[str, gtsam.Pose3]
    Y: dict[str, gtsam.Pose3]
    scales: dict[str, float]
    offsets_s: dict[str, float]


@dataclass(frozen=True)
class Variables:
    """Keys by name.

    Attributes
    ----------
    targets, sensors : dict of str to int
        Pose3 variables: X = T_targetcarrier_target, Y = T_sensorcarrier_sensor.
    scales : dict of str to int
        1-vectors: "scale" when one is shared, "scale:NAME" for each unknown one with scale="per_target".
    offsets : dict of str to int
        1-vectors in seconds: "time_offset:SENSOR".
    fixed : frozenset of str
        Frames that are known exactly; in the graph, but not unknown.
    scale_of_pair : dict of (target, sensor) to str
        Which scale a pair's translations are multiplied by; pairs of known scale are absent.
    """

    targets: dict[str, int]
    sensors: dict[str, int]
    scales: dict[str, int]
    offsets: dict[str, int]
    fixed: frozenset[str]
    scale_of_pair: dict[Pair, str]

    @staticmethod
    def of(problem: Problem, time_offsets: tuple[str, ...]) -> Variables:
        """Of a problem, with time offsets of the sensors named."""
        for name in problem.targets + problem.sensors:
            if name == "scale" or name.startswith(("scale:", "time_offset:")):
                raise FrameError(
                    f"a frame is called {name!r}, which is what refinement calls a scale or a time offset; rename it"
                )
        scale_of_pair: dict[Pair, str] = {}
        if problem.scale == "shared":
            scale_of_pair = dict.fromkeys(problem.pairs, "scale")
        elif problem.scale == "per_target":
            scale_of_pair = {
                pair: f"scale:{pair[0]}" for pair in problem.pairs if pair.target not in problem.fixed_scales
            }
        names = list(dict.fromkeys(scale_of_pair.values()))
        return Variables(
            targets={name: gtsam.symbol("x", i) for i, name in enumerate(problem.targets)},
            sensors={name: gtsam.symbol("y", i) for i, name in enumerate(problem.sensors)},
            scales={name: gtsam.symbol("s", i) for i, name in enumerate(names)},
            offsets={f"time_offset:{name}": gtsam.symbol("d", i) for i, name in enumerate(time_offsets)},
            fixed=frozenset(problem.fixed),
            scale_of_pair=scale_of_pair,
        )

    @property
    def frames(self) -> dict[str, int]:
        """Targets and sensors."""
        return self.targets | self.sensors

    @property
    def keys(self) -> dict[str, int]:
        """Every name's key."""
        return self.frames | self.scales | self.offsets

    @property
    def unknown(self) -> dict[str, int]:
        """Dimension of everything that is not known: six a free frame, one a scale or an offset."""
        frames = {name: 6 for name in self.frames if name not in self.fixed}
        return frames | dict.fromkeys(self.scales, 1) | dict.fromkeys(self.offsets, 1)

    def ends(self, pair: Pair) -> tuple[int, int]:
        """Keys of a pair's target and sensor; of a motion's, twice the sensor's."""
        return self.keys[pair.target], self.keys[pair.sensor]

    def scale_key(self, pair: Pair) -> int | None:
        """Key of the scale of a pair's translations."""
        return self.scales[self.scale_of_pair[pair]] if pair in self.scale_of_pair else None

    def offset_key(self, pair: Pair) -> int | None:
        """Key of the time offset of a pair's sensor."""
        return self.offsets.get(f"time_offset:{pair[1]}")

    def values(self, state: State) -> gtsam.Values:
        """An estimate as GTSAM's."""
        values = gtsam.Values()
        for keys, poses in ((self.targets, state.X), (self.sensors, state.Y)):
            for name, key in keys.items():
                values.insert(key, poses[name])
        for name, key in self.scales.items():
            values.insert(key, np.array([state.scales[name]]))
        for name, key in self.offsets.items():
            values.insert(key, np.array([state.offsets_s[name]]))
        return values

    def state(self, values: gtsam.Values) -> State:
        """GTSAM's values as an estimate."""
        return State(
            X={name: values.atPose3(key) for name, key in self.targets.items()},
            Y={name: values.atPose3(key) for name, key in self.sensors.items()},
            scales={name: float(values.atVector(key)[0]) for name, key in self.scales.items()},
            offsets_s={name: float(values.atVector(key)[0]) for name, key in self.offsets.items()},
        )

    def start(self, solution: Solution) -> State:
        """The certified solution as an estimate."""
        scales = {}
        for name in self.scales:
            owner = name.partition(":")[2]
            scales[name] = solution.scale[owner] if isinstance(solution.scale, dict) else float(solution.scale)
        return State(dict(solution.X), dict(solution.Y), scales, dict.fromkeys(self.offsets, 0.0))


def carrier_key(index: int) -> int:
    """Key of a carrier pose A = T_sensorcarrier_targetcarrier, where A's are variables."""
    key: int = gtsam.symbol("a", index)
    return key
