"""Whether tags are at their places on the stated board, by one homography or one pose; if not, the layout that fits.

A tag that was read wrongly, or a board that is not the stated one, is off by a tag's side and more. Errors of corners
and of intrinsics are far smaller, so that the limit `LARGEST_OFF` separates the two cases. Other layouts are tried,
those that are confused most often first; the message proposes the first that fits.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cache
from typing import TypeAlias

import cv2
import numpy as np

from gtsam_rwhec.cameras.camera import Camera
from gtsam_rwhec.cameras.targets import AprilGrid, Bundle, Charuco, TagGrid, square
from gtsam_rwhec.detect.tags import dictionary
from gtsam_rwhec.errors import TargetError
from gtsam_rwhec.geometry.poses import Array

#: A tag's corners are off their places by at most this share of the tag's shorter side, or by `LEAST_PX`.
LARGEST_OFF = 0.25
LEAST_PX = 2.0
#: Points are in one plane if they are nearer to it than this share of their extent.
FLAT = 1e-4
#: RANSAC for a pose tries this number of samples.
SAMPLES = 200


def agreeing(places: Array, flat: Array) -> np.ndarray:
    """Say which (m,) of a board's tags are in the largest set that fits one pose. A single tag agrees with itself.

    `places` (m, 4, 3) are the tags' corners in the board's frame, any unit; `flat` (m, 4, 2) is where they were seen,
    pixels of a camera without distortion, from its principal point; nan agrees with nothing.
    """
    seen = np.asarray(np.isfinite(flat).all(axis=(1, 2)))
    in_plane = plane_coordinates(places)
    if seen.sum() < 2:
        return seen
    agrees = np.zeros(len(places), dtype=bool)
    if in_plane is not None:
        agrees[seen] = _by_homography(in_plane[seen], flat[seen])
    return agrees


def largest_off(flat: Array) -> Array:
    """By how much (m,) corners of tags (m, 4, 2) may be off, pixels: a share of the shorter side, area / longest."""
    longest = np.linalg.norm(np.roll(flat, -1, axis=1) - flat, axis=2).max(axis=1)
    first, second = flat[:, 2] - flat[:, 0], flat[:, 3] - flat[:, 1]
    area = 0.5 * np.abs(first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0])
    return np.asarray(np.maximum(LARGEST_OFF * area / np.maximum(longest, 1e-9), LEAST_PX))


def agreeing_in_space(places: Array, x: Array, off: Array) -> np.ndarray:
    """`agreeing` for tags in several planes, with x (m, 4, 2) and off (m,) in normalised coordinates."""
    seen = np.asarray(np.isfinite(x).all(axis=(1, 2)))
    agrees = np.zeros(len(places), dtype=bool)
    if seen.sum() < 2:
        return seen
    points, pixels, largest = places[seen].reshape(-1, 3), x[seen].reshape(-1, 2), off[seen]
    try:
        found, turn, t, inliers = cv2.solvePnPRansac(
            points[:, None], pixels[:, None], np.eye(3), None,
            iterationsCount=SAMPLES, reprojectionError=float(np.median(largest)), flags=cv2.SOLVEPNP_SQPNP,
        )  # fmt: skip
        if not found or inliers is None or len(inliers) < 6:
            return agrees
        good = np.ravel(inliers)
        found, turn, t = cv2.solvePnP(
            points[good][:, None], pixels[good][:, None], np.eye(3), None, flags=cv2.SOLVEPNP_SQPNP
        )
    except cv2.error:
        return agrees  # degenerate samples only
    predicted = cv2.projectPoints(points, turn, t, np.eye(3), None)[0].reshape(-1, 4, 2)
    error = np.linalg.norm(predicted - pixels.reshape(-1, 4, 2), axis=2).max(axis=1)
    agrees[seen] = (error <= largest) & bool(found)
    return agrees


def all_agree(plane: Array, flat: Array) -> bool:
    """Whether all tags (m, 4, 2) of a plane, seen at `flat` (m, 4, 2), fit one least-squares homography."""
    return bool((_off(plane, flat) <= largest_off(flat)).all())


def spans_a_plane(plane: Array) -> bool:
    """Whether the middles of tags (m, 4, 2) are not all on one line."""
    if len(plane) < 3:
        return False
    off = plane.mean(axis=1) - plane.mean(axis=(0, 1))
    return int(np.linalg.matrix_rank(off, tol=1e-6 * float(np.abs(plane).max()))) == 2


def plane_coordinates(places: Array) -> Array | None:
    """Coordinates (m, 4, 2) of corners (m, 4, 3) in their plane, as seen from the printed side.

    None where they are not in one plane.
    """
    points = places.reshape(-1, 3)
    if not points[:, 2].any():
        return places[..., :2]
    middle = points.mean(axis=0)
    _, extent, axes = np.linalg.svd(points - middle, full_matrices=False)
    if extent[2] > FLAT * extent[0]:
        return None
    across, down = places[0, 1] - places[0, 0], places[0, 2] - places[0, 1]
    # A tag's normal is right x up; up is minus the vector from its second corner to its third.
    up = -down
    sign = np.sign(np.linalg.det(np.stack([axes[0], axes[1], np.cross(across, up)])))
    both = np.stack([axes[0], sign * axes[1]])
    return np.asarray((places - middle) @ both.T)


def _by_homography(plane: Array, flat: Array) -> np.ndarray:
    """`agreeing` for tags in one plane: RANSAC over the corners, then least squares over the tags that agree."""
    largest = largest_off(flat)
    agrees = _off(plane, flat) <= largest
    if agrees.all():
        return agrees
    agrees = _off(plane, flat, ransac_px=float(np.median(largest))) <= largest
    for _ in range(2):
        again = _off(plane, flat, agrees) <= largest if agrees.sum() > 1 else agrees
        if again.sum() < agrees.sum():
            break
        agrees = again
    return agrees


def _off(plane: Array, flat: Array, fitted: np.ndarray | None = None, ransac_px: float | None = None) -> Array:
    """How far (m,) a corner of each tag is off a homography of the `fitted` tags, pixels; infinite where none fits."""
    some = slice(None) if fitted is None else fitted
    method = (0,) if ransac_px is None else (cv2.RANSAC, ransac_px)
    H, _ = cv2.findHomography(plane[some].reshape(-1, 2), flat[some].reshape(-1, 2), *method)
    if H is None or not np.isfinite(H).all():
        return np.full(len(plane), np.inf)
    predicted = cv2.perspectiveTransform(plane.reshape(-1, 1, 2), H).reshape(flat.shape)
    return np.asarray(np.linalg.norm(predicted - flat, axis=2).max(axis=1))


#: Fewer tags fit too many layouts.
LEAST_TAGS = 3
#: Boards with up to this number of columns are tried.
MOST_COLUMNS = 30
#: Orders of ids on a grid: whether they run from the left, from the top, and along rows first.
ORDERS = [(left, top, along) for along in (True, False) for top in (True, False) for left in (True, False)]


#: The tags' places (m, 4, 2) in a possible layout, any unit, and what the rig file must say for it.
_Layout: TypeAlias = tuple[Array, str]


def layout_that_fits(board: Charuco | AprilGrid | TagGrid, ids: np.ndarray, flat: Array) -> str:
    """What to write in the rig file so that all tags `ids` (m,), seen at `flat` (m, 4, 2), are where the board says.

    Empty if no layout that is tried fits, or if fewer than three tags, or tags of one row only, were seen.
    """
    if len(np.unique(ids)) < max(LEAST_TAGS, len(ids)) or not np.isfinite(flat).all():
        return ""
    turns = range(4) if isinstance(board, AprilGrid) else (0,)
    for plane, cure in _charucos(board, ids) if isinstance(board, Charuco) else _grids(board, ids):
        if spans_a_plane(plane) and any(all_agree(plane, np.roll(flat, turn, axis=1)) for turn in turns):
            return cure
    return ""


def _charucos(board: Charuco, ids: np.ndarray) -> Iterator[_Layout]:
    # columns, rows, first_id, and what to write
    tried = [(board.rows, board.columns, board.first_id, f"write squares: [{board.rows}, {board.columns}]")]
    count = board.columns * board.rows // 2
    for first in range(board.first_id - int(ids.min()), board.first_id + count):
        if first != board.first_id and first <= ids.min() and ids.max() < first + count:
            tried.append((board.columns, board.rows, first, f"write first_id: {first}"))
    for columns in range(2, MOST_COLUMNS):
        needed = int(np.ceil(2 * (ids.max() - board.first_id + 1) / columns))
        rows = max(needed, board.columns * board.rows // columns, 2)
        words = f"count the squares: the markers fit {columns} columns, as in squares: [{columns}, {rows}]"
        tried.append((columns, rows, board.first_id, words))
    for columns, rows, first, words in tried:
        try:
            candidate = replace(board, columns=columns, rows=rows, first_id=first)
        except TargetError:  # its family has too few markers
            continue
        for is_legacy in (False, True):
            cells = _markers(candidate, is_legacy)
            rows_of = ids - candidate.first_id
            if rows_of.min() >= 0 and rows_of.max() < len(cells):
                yield _tags(cells[rows_of], candidate.square_m, candidate.marker_m), words


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
        yield _tags(cells, board.tag_m + gap, board.tag_m), cure


def _cells(k: np.ndarray, columns: int, rows: int, order: tuple[bool, bool, bool]) -> Array:
    """Columns and rows from the top (m, 2) of the k-th tags (m,)."""
    from_left, from_top, along_rows = order
    column, row = (k % columns, k // columns) if along_rows else (k // rows, k % rows)
    return np.stack(
        [column if from_left else columns - 1 - column, row if from_top else rows - 1 - row], axis=1
    ).astype(float)


def _listed(columns: int, rows: int, order: tuple[bool, bool, bool], first: int) -> list[int]:
    """All ids of the grid, row by row from the top, left to right."""
    cells = _cells(np.arange(columns * rows), columns, rows, order).astype(int)
    found = np.zeros((rows, columns), dtype=int)
    found[cells[:, 1], cells[:, 0]] = first + np.arange(columns * rows)
    return [int(i) for i in found.ravel()]


def _tags(cells: Array, step_m: float, side_m: float) -> Array:
    """Corners (m, 4, 2) of tags in the middles of cells (m, 2), y up."""
    middles = step_m * cells * [1.0, -1.0]
    return np.asarray(middles[:, None] + square(side_m)[:, :2])


#: Boards whose corners come from several tags.
TagBoard: TypeAlias = Charuco | AprilGrid | TagGrid | Bundle
#: At most this share of a board's tags, or one of three and more, may be at wrong places: they are not used. If there
#: are more, it is another board.
MOST_ELSEWHERE = 0.25


@dataclass(frozen=True, eq=False)
class BoardTags:
    """Tags of a board in an image."""

    ids: np.ndarray  #: (m,)
    corners_px: Array  #: (m, 4, 2): in the order of the board's own corners, right to about a pixel
    contradicted: bool = False  #: The tags are not where the board says: none may be used
    note: str = ""  #: What the rig file would have to say instead, as far as it is known
    is_legacy: bool = False  #: Whether a ChArUco board has the pattern of OpenCV before 4.6.


@cache
def charuco_board(board: Charuco, is_legacy: bool = False) -> cv2.aruco.CharucoBoard:
    """OpenCV's board. Before OpenCV 4.6, boards with an even number of rows had dark and light squares exchanged."""
    made = cv2.aruco.CharucoBoard(
        (board.columns, board.rows),
        board.square_m,
        board.marker_m,
        dictionary(board.family),
        np.array(board.ids, dtype=np.int32),
    )
    made.setLegacyPattern(is_legacy)
    return made


@cache
def tag_places(board: TagBoard, is_legacy: bool = False) -> Array:
    """Corners (n, 4, 3) of a board's tags in its frame, in the order of its ids, metres."""
    if isinstance(board, Charuco):
        # OpenCV's origin is the outer corner at the top left, y is down.
        places = np.array(charuco_board(board, is_legacy).getObjPoints(), dtype=float).reshape(-1, 4, 3)
        outer = 0.5 * board.square_m * np.array([-board.columns, board.rows, 0.0])
        return np.asarray(places * [1.0, -1.0, 0.0] + outer)
    return board.corners().reshape(-1, 4, 3)


def tags_of_board(board: TagBoard, ids: np.ndarray, corners_px: Array, camera: Camera) -> BoardTags:
    """Test tags (m,) of a board, seen at (m, 4, 2); the returned ones agree, unless the board is contradicted."""
    x = camera.undistort(corners_px)
    focal = camera.focal_px
    number = {i: k for k, i in enumerate(board.ids)}
    of_board = np.array([number[int(i)] for i in ids], dtype=int)
    is_legacy = False
    if isinstance(board, AprilGrid):
        turn = _quarter_turns(tag_places(board)[of_board], x * focal)
        corners_px, x = np.roll(corners_px, turn, axis=1), np.roll(x, turn, axis=1)
    agrees = _agrees(board, of_board, x, focal, False)
    if isinstance(board, Charuco) and board.rows % 2 == 0 and not agrees.all():
        as_before = _agrees(board, of_board, x, focal, True)
        if as_before.sum() > agrees.sum():
            agrees, is_legacy = as_before, True
    if not agrees.all():
        # Tags of one row agree in another layout too.
        elsewhere = len(agrees) - int(agrees.sum())
        note = "" if isinstance(board, Bundle) else layout_that_fits(board, ids, x * focal)
        few = not (isinstance(board, Bundle) or spans_a_plane(tag_places(board, is_legacy)[of_board[agrees], :, :2]))
        if note or few or agrees.sum() < 2 or elsewhere > max(1.0, MOST_ELSEWHERE * len(agrees)):
            return BoardTags(ids, corners_px, True, note)
    once = np.array([np.sum(ids[agrees] == i) == 1 for i in ids], dtype=bool)
    kept = agrees & once
    return BoardTags(ids[kept], corners_px[kept], is_legacy=is_legacy)


def _agrees(board: TagBoard, of_board: np.ndarray, x: Array, focal: float, is_legacy: bool) -> np.ndarray:
    places = tag_places(board, is_legacy)[of_board]
    if isinstance(board, Bundle) and len(places) > 1 and plane_coordinates(places) is None:
        return agreeing_in_space(places, x, largest_off(x * focal) / focal)
    return agreeing(places, x * focal)


def _quarter_turns(places: Array, flat: Array) -> int:
    """By how many quarter turns a grid's tags are turned in their places: generators of grids differ in this."""
    if not np.isfinite(flat).all():
        return 0
    return int(np.argmin([np.median(_off(places[..., :2], np.roll(flat, turn, axis=1))) for turn in range(4)]))
