"""What a refinement estimates, one record each: how it is written is decided here alone."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from enum import Enum
from typing import NamedTuple

import numpy as np


class UnknownKind(Enum):
    """What an unknown is; the value is the word that files and users have for it."""

    FRAME = "frame"
    SCALE = "scale"
    TIME_OFFSET = "time_offset"


class Unknown(NamedTuple):
    """The pose of a frame, a scale, or the time offset of a sensor's clock.

    ``owner`` is the frame, target or sensor that it belongs to; empty for one scale that all targets share.
    """

    kind: UnknownKind
    owner: str = ""

    @staticmethod
    def of(name: str | Unknown) -> Unknown:
        """What users call it: "cam_0", "scale", "scale:tag_0" or "time_offset:cam_0"."""
        if isinstance(name, Unknown):
            return name
        if name == UnknownKind.SCALE.value:
            return Unknown(UnknownKind.SCALE)
        word, separator, owner = name.partition(":")
        for kind in (UnknownKind.SCALE, UnknownKind.TIME_OFFSET):
            if separator and word == kind.value:
                return Unknown(kind, owner)
        return Unknown(UnknownKind.FRAME, name)

    def __str__(self) -> str:
        """The name that ``of`` reads."""
        if self.kind is UnknownKind.FRAME:
            return self.owner
        return f"{self.kind.value}:{self.owner}" if self.owner else self.kind.value

    @property
    def dimension(self) -> int:
        """Parameters that it has: [omega, v] of a frame, or one number."""
        return 6 if self.kind is UnknownKind.FRAME else 1


def slots_of(unknowns: Iterable[Unknown]) -> dict[Unknown, slice]:
    """Where each one's parameters are when all of them stand one after the other."""
    slots, first = {}, 0
    for unknown in unknowns:
        slots[unknown] = slice(first, first + unknown.dimension)
        first += unknown.dimension
    return slots


def rows_of(slots: Mapping[Unknown, slice], unknowns: Iterable[Unknown]) -> np.ndarray:
    """The indices (m,) of some of them, in the order given."""
    return np.array(
        [row for unknown in unknowns for row in range(slots[unknown].start, slots[unknown].stop)], dtype=np.int64
    )
