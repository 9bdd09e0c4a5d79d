"""What targets share: families of tags, limits of their numbers and lengths, squares and grids of points."""

from __future__ import annotations

import numpy as np

from gtsam_rwhec.errors import TargetError
from gtsam_rwhec.geometry.poses import Array

#: Each family has this number of tags.
FAMILIES: dict[str, int] = {
    "tag16h5": 30, "tag25h9": 35, "tag36h10": 2320, "tag36h11": 587,
    **{f"aruco_{n}x{n}_{count}": count for n in (4, 5, 6, 7) for count in (50, 100, 250, 1000)},
    "aruco_original": 1024, "aruco_mip_36h12": 250,
}  # fmt: skip
#: Lengths of targets must be below this (m), since longer lengths are probably millimetres.
LARGEST_M = 10.0


def square(side_m: float) -> Array:
    """Corners (4, 3) of a square about the origin, in the order top left, top right, bottom right, bottom left."""
    return 0.5 * side_m * np.array([[-1.0, 1.0, 0.0], [1.0, 1.0, 0.0], [1.0, -1.0, 0.0], [-1.0, -1.0, 0.0]])


def grid(columns: int, rows: int, step_m: float) -> Array:
    """Points (columns rows, 3) of a grid about the origin, left to right, from the top."""
    x, y = np.meshgrid(np.arange(columns) - 0.5 * (columns - 1), 0.5 * (rows - 1) - np.arange(rows))
    return step_m * np.stack([x.ravel(), y.ravel(), np.zeros(columns * rows)], axis=1)


def check(name: str, family: str | None, ids: tuple[int, ...], lengths: dict[str, float]) -> None:
    """Raise `TargetError` if there is no such family, if ids are not in it, or if a length is no length."""
    if family is not None:
        if family not in FAMILIES:
            raise TargetError(f"there is no family {family!r}; there are {', '.join(FAMILIES)}", name)
        if min(ids) < 0 or max(ids) >= FAMILIES[family]:
            raise TargetError(f"ids {min(ids)} to {max(ids)} are not in {family}: 0 to {FAMILIES[family] - 1}", name)
    for word, length in lengths.items():
        if not 0.0 < length < LARGEST_M:
            raise TargetError(f"{word} = {length!r}; give metres, above 0 and below {LARGEST_M:g}", name)


def check_different(name: str, ids: tuple[int, ...]) -> None:
    """Raise `TargetError` if an id is there twice."""
    twice = sorted({i for i in ids if ids.count(i) > 1})
    if twice:
        raise TargetError(f"id {twice[0]} is there {ids.count(twice[0])} times; each tag needs its own", name)


def check_grid(name: str, columns: int, rows: int, least: int) -> None:
    """Raise `TargetError` if a grid has too few or too many columns or rows."""
    if not (least <= columns <= 100 and least <= rows <= 100):
        raise TargetError(f"{columns} columns and {rows} rows; each must be {least} to 100", name)
