"""How many functions a call calls: what tells a loop in Python on any machine, however busy it is."""

from __future__ import annotations

import sys
from collections.abc import Callable
from typing import Any, TypeVar

T = TypeVar("T")


def counted_calls(call: Callable[[], T]) -> tuple[T, int]:
    """What `call` gives, and how many calls of functions, Python's and C's, it took."""
    count = 0

    def on_event(frame: object, event: str, argument: Any) -> None:
        nonlocal count
        count += event in ("call", "c_call")

    before = sys.getprofile()
    sys.setprofile(on_event)
    try:
        result = call()
    finally:
        sys.setprofile(before)
    return result, count
