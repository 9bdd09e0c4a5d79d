"""The parts of an image without corners, in words: "nothing was seen in the upper left quarter"."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

#: A part with corners in at most this share of its cells has hardly any.
HARDLY = 0.17
#: By name: the rows and columns of a part, as shares of the image. Parts of parts that are named are not named again.
PARTS = {
    "left half": ((0.0, 1.0), (0.0, 0.5)),
    "right half": ((0.0, 1.0), (0.5, 1.0)),
    "upper half": ((0.0, 0.5), (0.0, 1.0)),
    "lower half": ((0.5, 1.0), (0.0, 1.0)),
    "upper left quarter": ((0.0, 0.5), (0.0, 0.5)),
    "upper right quarter": ((0.0, 0.5), (0.5, 1.0)),
    "lower left quarter": ((0.5, 1.0), (0.0, 0.5)),
    "lower right quarter": ((0.5, 1.0), (0.5, 1.0)),
}
#: The outermost cells of each side.
EDGES: Mapping[str, tuple[slice, slice]] = {
    "left edge": (slice(None), slice(0, 1)),
    "right edge": (slice(None), slice(-1, None)),
    "upper edge": (slice(0, 1), slice(None)),
    "lower edge": (slice(-1, None), slice(None)),
}


def empty_in_words(cells: Sequence[Sequence[int]]) -> str:
    """A sentence about the parts of an image without corners; `cells` has the number of corners, rows from the top."""
    has = np.array(cells) > 0
    if has.all():
        return "every part of its image has corners."
    if not has.any():
        return "no part of its image has corners."
    told = np.zeros(has.shape, dtype=bool)
    nothing: list[str] = []
    hardly: list[str] = []
    for name, (rows, columns) in PARTS.items():
        part = np.zeros(has.shape, dtype=bool)
        (top, bottom), (left, right) = (
            [round(share * n) for share in shares] for shares, n in zip((rows, columns), has.shape, strict=True)
        )
        part[top:bottom, left:right] = True
        if told[part].all() or has[part].mean() > HARDLY:
            continue
        (hardly if has[part].any() else nothing).append(f"in the {name}")
        told |= part
    for name, edge in EDGES.items():
        if not has[edge].any() and not told[edge].all():
            nothing.append(f"along the {name}")
    said = [f"{words} was seen {_and(where)}" for words, where in (("nothing", nothing), ("hardly anything", hardly))
            if where]  # fmt: skip
    if said:
        return f"{'; '.join(said)}."
    return f"{int((~has).sum())} of {has.size} cells have no corner, none of them a whole side or quarter."


def _and(words: Sequence[str]) -> str:
    return words[0] if len(words) == 1 else f"{', '.join(words[:-1])} and {words[-1]}"
