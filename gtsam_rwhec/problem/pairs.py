"""Names of pairs: a target and the sensor that saw it, or a sensor with motions of its own."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple, TypeAlias, TypeVar

Value = TypeVar("Value")


class Pair(NamedTuple):
    """A target and the sensor that saw it; for motions of a sensor (A Y = Y B), the sensor's name twice.

    A pair is a tuple, so ``solution.residuals["tag_0", "cam_0"]`` finds it.
    """

    target: str
    sensor: str

    @property
    def is_motion(self) -> bool:
        """Whether the measurements are motions of one sensor (AX = XB)."""
        return self.target == self.sensor

    @property
    def frames(self) -> tuple[str, ...]:
        """The names of the frames: target and sensor, or the sensor alone for motions."""
        return (self.sensor,) if self.is_motion else tuple(self)

    @property
    def label(self) -> str:
        """The pair's name in messages and tables: "tag_0-cam_0" or "the motions of cam_0"; also ``str(pair)``."""
        return f"the motions of {self.sensor}" if self.is_motion else f"{self.target}-{self.sensor}"

    def __str__(self) -> str:
        return self.label


#: Values by pair as users give them: a key may be a plain tuple.
ByPair: TypeAlias = Mapping[Pair, Value] | Mapping[tuple[str, str], Value]
