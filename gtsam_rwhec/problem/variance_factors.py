"""How noisy measurements are over what was stated of them."""

from __future__ import annotations

from typing import NamedTuple


class VarianceFactors(NamedTuple):
    """By what the stated variances of B's rotations and translations are multiplied; 1: the noise is as stated."""

    rotation: float
    translation: float


AS_STATED = VarianceFactors(1.0, 1.0)
