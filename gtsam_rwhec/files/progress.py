"""The progress of a long calculation: a callable that takes the name of each stage."""

from __future__ import annotations

from collections.abc import Callable

Progress = Callable[[str], None]


def silent(stage: str) -> None:
    """Report nothing."""
