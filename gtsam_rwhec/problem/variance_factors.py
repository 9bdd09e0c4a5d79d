"""How noisy the measurements are, as a multiple of the stated noise."""

from __future__ import annotations

from typing import NamedTuple


class VarianceFactors(NamedTuple):
    """Factors of the stated variances of B's rotations and translations; 1 means that the noise is as stated."""

    rotation: float
    translation: float


AS_STATED = VarianceFactors(1.0, 1.0)
