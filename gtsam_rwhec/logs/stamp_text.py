"""Stamps written as text, as names of files and first fields of tables have them."""

from __future__ import annotations

import re
from decimal import Decimal

#: A stamp in nanoseconds has at least this many digits.
NANOSECOND_DIGITS = 16


def as_ns(text: str) -> int | None:
    """Exact nanoseconds of a stamp in seconds (with a decimal point or an exponent) or nanoseconds; else None."""
    if re.fullmatch(rf"\d{{{NANOSECOND_DIGITS},19}}", text, flags=re.ASCII):
        stamp = int(text)
    elif re.fullmatch(r"\d{1,10}\.\d{1,15}|\d\.\d{1,20}[eE]\+?0?\d", text, flags=re.ASCII):
        stamp = int((Decimal(text) * 10**9).to_integral_value())
    else:
        return None
    return stamp if stamp < 1 << 63 else None
