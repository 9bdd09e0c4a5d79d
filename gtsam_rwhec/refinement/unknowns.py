"""The unknowns of a refinement as records, and their names as users and files write them."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from enum import Enum
from typing import NamedTuple

import numpy as np

from gtsam_rwhec.errors import FrameError
from gtsam_rwhec.files.terminal_text import brief


class UnknownKind(Enum):
    """The kind of an unknown; the value is its word in files and names."""

    FRAME = "frame"
    SCALE = "scale"
    TIME_OFFSET = "time_offset"
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
