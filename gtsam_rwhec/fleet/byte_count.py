"""How many bytes came from a store, counted where they are read and told to whoever asked."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass


@dataclass
class ByteCount:
    """Bytes, and the requests that brought them."""

    count: int = 0
    requests: int = 0


_counting: ContextVar[tuple[ByteCount, ...]] = ContextVar("counting", default=())


@contextmanager
def counted_bytes() -> Iterator[ByteCount]:
    """Count in the block; blocks within blocks count each for themselves."""
    count = ByteCount()
    token = _counting.set((*_counting.get(), count))
    try:
        yield count
    finally:
        _counting.reset(token)


def count_bytes(count: int, requests: int = 1) -> None:
    """Tell all that count of bytes that came."""
    for one in _counting.get():
        one.count += count
        one.requests += requests
