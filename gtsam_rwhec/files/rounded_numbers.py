"""Numbers in sentences: a few digits, and no exponents where people read lengths, angles and shares."""

from __future__ import annotations


def rounded(value: float, digits: int = 2) -> str:
    """A number with so many digits, and without an exponent from 0.0001 up to a million."""
    return f"{float(f'{value:.{digits}g}'):g}"
