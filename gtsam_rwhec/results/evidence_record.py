"""What all records of the evidence share: they are strict, and they hold no number that is not finite."""

from __future__ import annotations

from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field

#: A number of a file that may come from anyone: its square, and sums of many, are still finite.
Bounded = Annotated[float, Field(ge=-1e60, le=1e60)]
#: Rows of numbers: an array as JSON has it.
Row = tuple[Bounded, ...]
Rows = tuple[Row, ...]


class EvidenceRecord(BaseModel):
    """The base of all records of ``evidence.json``. A number that is not known is None."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)
