"""What the records of evidence and logs share: they are strict, and they hold no number that is not finite."""

from __future__ import annotations

from typing import Annotated, TypeAlias

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

Count: TypeAlias = Annotated[int, Field(ge=0)]
PositiveCount: TypeAlias = Annotated[int, Field(gt=0)]
Positive: TypeAlias = Annotated[float, Field(gt=0.0)]
NotNegative: TypeAlias = Annotated[float, Field(ge=0.0)]
#: A number of a file that may come from anyone: its square, and sums of many, are still finite.
Bounded: TypeAlias = Annotated[float, Field(ge=-1e60, le=1e60)]
#: Rows of numbers: an array as JSON has it.
Row: TypeAlias = tuple[Bounded, ...]
Rows: TypeAlias = tuple[Row, ...]
Triple: TypeAlias = tuple[float, float, float]


def triple(values: np.ndarray) -> Triple:
    """Three numbers, none of which is -0."""
    x, y, z = (float(value) + 0.0 for value in values)
    return x, y, z


class FileRecord(BaseModel):
    """The base of all records of ``evidence.json``, and of those of a log. A number that is not known is None."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)
