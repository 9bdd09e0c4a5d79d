"""What a long calculation tells its caller: the name of each stage."""

from __future__ import annotations

from collections.abc import Callable

Progress = Callable[[str], None]


def silent(stage: str) -> None:
    """For a caller that does not ask."""
