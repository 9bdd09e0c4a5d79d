"""The console for rich text. It checks what rich renders, so that no name in a table controls the terminal."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from rich.console import Console, ConsoleOptions, RenderableType
from rich.segment import Segment

from gtsam_rwhec.files.terminal_text import printable


class SafeConsole(Console):
    """A console that prints no text as a terminal command or as markup: "[red]" is printed as it is."""

    def __init__(self, **options: Any) -> None:
        super().__init__(highlight=False, markup=False, emoji=False, **options)

    def render(self, renderable: RenderableType, options: ConsoleOptions | None = None) -> Iterable[Segment]:
        """Rich's segments with their text escaped; its own control codes are in segments of their own."""
        for segment in super().render(renderable, options):
            if segment.control or segment.text.replace("\n", "").isprintable():
                yield segment
            else:
                yield Segment(printable(segment.text), segment.style)
