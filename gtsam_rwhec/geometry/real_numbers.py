"""What users give: numbers that are real, and objects of the right kind; or a message about what they are instead."""

from __future__ import annotations

import math
from numbers import Integral, Real
from types import UnionType
from typing import Any, TypeGuard

import numpy as np
from numpy.typing import NDArray

from gtsam_rwhec.errors import OptionError

#: Seeds and numbers of iterations are handed to libraries that have integers of 32 bits.
LARGEST_WHOLE = 2**31 - 1
#: NumPy's kinds of numbers, and of objects, which may be numbers.
_KINDS = "biufO"


def check_kind(value: object, kind: type | UnionType, what: str, give: str) -> None:
    """An OptionError where a value is of another kind: ``what`` it is called, and what to give in its place."""
    if not isinstance(value, kind):
        raise OptionError(f"{what} is a {type(value).__name__}; give {give}")


def is_real(value: object) -> TypeGuard[float]:
    """Whether a value is one real number: not true or false, not a duration, not an array with one entry."""
    return isinstance(value, Real) and not isinstance(value, bool | np.timedelta64)


def is_between(value: object, least: float, largest: float) -> TypeGuard[float]:
    """Whether a value is one real number from ``least`` to ``largest``; NaN is not."""
    return is_real(value) and bool(least <= value <= largest)


def finite_or_none(value: float) -> float | None:
    """The same number, or None where it is infinite or NaN: files in JSON have neither."""
    return value if math.isfinite(value) else None


def is_whole(value: object, least: int) -> TypeGuard[int]:
    """Whether a value is one whole number of at least ``least`` that fits the integers of other libraries."""
    return isinstance(value, Integral) and is_real(value) and bool(least <= value <= LARGEST_WHOLE)


def is_one_of(value: object, choices: tuple[object, ...]) -> bool:
    """Whether a value is a text among the choices; an array is not compared entry by entry."""
    return isinstance(value, str) and value in choices


def real_array(values: Any) -> NDArray[np.float64]:
    """Real numbers as an array of doubles; the array itself where it is one already.

    Raises `ValueError` for anything else, in words that follow "cannot be read as numbers": text (also "1.5"), complex
    numbers, masked arrays, times, lists of different lengths, integers beyond the largest double.
    """
    if isinstance(values, np.ma.MaskedArray):
        raise ValueError("a masked array; leave masked measurements out")
    try:
        array = np.asarray(values)
        if array.dtype.kind == "c":
            raise ValueError("complex numbers; give real numbers")
        if array.dtype.kind not in _KINDS:
            found = f" such as {array.flat[0].item()!r:.60}" if array.size else ""
            raise ValueError(f"{_NAMES.get(array.dtype.kind, 'records')}{found}")
        return np.asarray(array, dtype=np.float64)
    except (TypeError, OverflowError) as error:
        raise ValueError(str(error)) from error


_NAMES = {"U": "text", "S": "bytes", "M": "times", "m": "durations"}
