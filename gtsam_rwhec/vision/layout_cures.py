"""The layout that fits where a board's tags are: columns and rows exchanged, another first id, another order of ids.

All tags that are seen must agree with one homography. Layouts are tried in the order in which people take one for
another; the first that fits is what the message proposes.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from gtsam_rwhec.errors import TargetError
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.vision.tag_agreement import all_agree, spans_a_plane
from gtsam_rwhec.vision.tag_boards import TagGrid
from gtsam_rwhec.vision.target_checks import square
from gtsam_rwhec.vision.targets import AprilGrid, Charuco

#: Fewer tags fit too many layouts.
LEAST_TAGS = 3
#: Boards with up to this number of columns are tried.
MOST_COLUMNS = 30
#: Orders of ids on a grid: whether they run from the left, from the top, and along rows first.
ORDERS = [(left, top, along) for along in (True, False) for top in (True, False) for left in (True, False)]


@dataclass(frozen=True, eq=False)
class _Layout:
    """Where tags would be, (m, 4, 2) in any unit, and what the rig file would say."""

    plane: Array
    cure: str


def layout_that_fits(board: Charuco | AprilGrid | TagGrid, ids: np.ndarray, flat: Array) -> str:
    """What to write in the rig file so that all tags `ids` (m,), seen at `flat` (m, 4, 2), are where the board says.

    Empty where nothing that is tried fits, and where fewer than three tags, or tags of one row, were seen.
    """
    if len(np.unique(ids)) < max(LEAST_TAGS, len(ids)) or not np.isfinite(flat).all():
        return ""
    for layout in _charucos(board, ids) if isinstance(board, Charuco) else _grids(board, ids):
        turns = range(4) if isinstance(board, AprilGrid) else (0,)
        if spans_a_plane(layout.plane) and any(all_agree(layout.plane, np.roll(flat, t, axis=1)) for t in turns):
            return layout.cure
    return ""


def _charucos(board: Charuco, ids: np.ndarray) -> Iterator[_Layout]:
    tried = [(replace_sizes(board, board.rows, board.columns), f"write squares: [{board.rows}, {board.columns}]")]
    count = board.columns * board.rows // 2
    for shift in range(-int(ids.min()), count):
        if shift and board.first_id + shift <= ids.min() and ids.max() < board.first_id + shift + count:
            tried.append((_shifted(board, shift), f"write first_id: {board.first_id + shift}"))
    for columns in range(2, MOST_COLUMNS):
        rows = int(np.ceil(2 * (ids.max() - board.first_id + 1) / columns))
        whole = board.columns * board.rows // columns
        words = (
            f"count the squares: the markers fit {columns} columns, as in squares: [{columns}, {max(rows, whole, 2)}]"
        )
        tried.append((replace_sizes(board, columns, max(rows, whole, 2)), words))
    for candidate, words in tried:
        if candidate is None:
            continue
        for is_legacy in (False, True):
            cells = _markers(candidate, is_legacy)
            rows_of = ids - candidate.first_id
            if rows_of.min() >= 0 and rows_of.max() < len(cells):
                yield _Layout(_tags(cells[rows_of], candidate.square_m, candidate.marker_m), words)


def replace_sizes(board: Charuco, columns: int, rows: int) -> Charuco | None:
    """The board with other numbers of squares; None if its family has too few markers."""
    try:
        return replace(board, columns=columns, rows=rows)
    except TargetError:
        return None


def _shifted(board: Charuco, shift: int) -> Charuco | None:
    try:
        return replace(board, first_id=board.first_id + shift)
    except TargetError:
        return None


def _markers(board: Charuco, is_legacy: bool) -> Array:
    """Columns and rows (n, 2) of a board's markers, by OpenCV's two patterns."""
    rows, columns = np.indices((board.rows, board.columns))
    odd = is_legacy and board.rows % 2 == 0
    white = (rows + columns) % 2 == (0 if odd else 1)
    return np.stack([columns[white], rows[white]], axis=1).astype(float)


def _grids(board: AprilGrid | TagGrid, ids: np.ndarray) -> Iterator[_Layout]:
    """Grids with other sizes, other first ids and other orders of ids."""
    is_kalibrs = isinstance(board, AprilGrid)
    gap = board.spacing * board.tag_m if isinstance(board, AprilGrid) else board.gap_m
    first, usual = min(board.ids), (True, not is_kalibrs, True)
    sizes = [(board.columns, board.rows), (board.rows, board.columns)]
    count = board.columns * board.rows
    shifts = [s for s in range(-count, count + 1) if s and first + s >= 0]
    tried = [(size, 0, order) for order in sorted(ORDERS, key=lambda o: o != usual) for size in sizes]
    tried += [(sizes[0], shift, usual) for shift in sorted(shifts, key=abs)]
    tried += [((columns, 0), 0, usual) for columns in range(2, MOST_COLUMNS)]
    for (columns, rows), shift, order in tried:
        k = ids - first - shift
        needed = int(k.max()) // columns + 1
        if k.min() < 0 or (rows and k.max() >= columns * rows):
            continue
        cells = _cells(k, columns, rows or needed, order)
        if order == usual and not rows:
            size = [columns, max(needed, count // columns)]
            cure = f"count the tags: the ids fit {columns} columns, as in tags: {size}"
        elif order == usual:
            cure = f"write first_id: {first + shift}" if shift else f"write tags: [{columns}, {rows}]"
        else:
            listed = _listed(columns, rows, order, first)
            tags = f"tags: [{columns}, {rows}], ids: [{', '.join(map(str, listed))}]"
            as_grid = f"type: tag_grid, tag_m: {board.tag_m:g}, gap_m: {gap:g}, "
            cure = f"write {as_grid if is_kalibrs else ''}{tags}"
        yield _Layout(_tags(cells, board.tag_m + gap, board.tag_m), cure)


def _cells(k: np.ndarray, columns: int, rows: int, order: tuple[bool, bool, bool]) -> Array:
    """Columns and rows from the top (m, 2) of the k-th tags (m,)."""
    from_left, from_top, along_rows = order
    column, row = (k % columns, k // columns) if along_rows else (k // rows, k % rows)
    return np.stack(
        [column if from_left else columns - 1 - column, row if from_top else rows - 1 - row], axis=1
    ).astype(float)


def _listed(columns: int, rows: int, order: tuple[bool, bool, bool], first: int) -> list[int]:
    """All ids, left to right, from the top."""
    cells = _cells(np.arange(columns * rows), columns, rows, order).astype(int)
    found = np.zeros((rows, columns), dtype=int)
    found[cells[:, 1], cells[:, 0]] = first + np.arange(columns * rows)
    return [int(i) for i in found.ravel()]


def _tags(cells: Array, step_m: float, side_m: float) -> Array:
    """Corners (m, 4, 2) of tags in the middles of cells (m, 2), y up."""
    middles = step_m * cells * [1.0, -1.0]
    return np.asarray(middles[:, None] + square(side_m)[:, :2])
