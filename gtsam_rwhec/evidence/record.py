"""What all records of the evidence share: they are strict, and they hold no number that is not finite."""

from __future__ import annotations

from pydantic import BaseModel, ConfigDict

#: Rows of numbers: an array as JSON has it.
Row = tuple[float, ...]
Rows = tuple[Row, ...]


class EvidenceRecord(BaseModel):
    """The base of all records of ``evidence.json``. A number that is not known is None."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)
