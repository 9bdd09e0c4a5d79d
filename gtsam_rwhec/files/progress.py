"""The progress of a long calculation: a callable that takes the name of each stage."""

from __future__ import annotations

from collections.abc import Callable

from gtsam_rwhec.errors import OptionError

Progress = Callable[[str], None]


def check_progress(progress: object) -> None:
    """Raise an OptionError for a progress that cannot be called."""
    if progress is not None and not callable(progress):
        raise OptionError(
            f"progress is a {type(progress).__name__}; give a callable that takes the name of each stage, such as print"
        )


def silent(stage: str) -> None:
    """Report nothing."""
