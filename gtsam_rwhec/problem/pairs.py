"""Who saw whom: a sensor and a target, or a sensor and its own motion."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple, TypeAlias, TypeVar

Value = TypeVar("Value")


class Pair(NamedTuple):
    """A target and the sensor that saw it; for motions of a sensor's own (A Y = Y B), twice that sensor.

    It is a tuple, so that ``solution.residuals["tag_0", "cam_0"]`` finds it.
    """

    target: str
    sensor: str

    @property
    def is_motion(self) -> bool:
        """Whether both ends are one sensor (AX = XB)."""
        return self.target == self.sensor

    @property
    def frames(self) -> tuple[str, ...]:
        """The names of its frames: two, or a motion's one."""
        return (self.sensor,) if self.is_motion else tuple(self)

    @property
    def label(self) -> str:
        """How messages and tables write it: "tag_0-cam_0", or "the motions of cam_0"; also ``str(pair)``."""
        return f"the motions of {self.sensor}" if self.is_motion else f"{self.target}-{self.sensor}"

    def __str__(self) -> str:
        return self.label


#: What users give for each pair: bare tuples do.
ByPair: TypeAlias = Mapping[Pair, Value] | Mapping[tuple[str, str], Value]
