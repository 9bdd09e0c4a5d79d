"""Sightings of targets with tags: corners of single tags and of boards, before their poses.

Tags of boards count only where their board has them (`board_tags`). Corners of single tags, of grids of tags and of
bundles come from the tags' edges, many tags of many images at once; those of ChArUco boards and AprilGrids are points
where two dark squares meet.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np

from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.vision import boards
from gtsam_rwhec.vision.board_tags import BoardTags, TagBoard, tag_places, tags_of_board
from gtsam_rwhec.vision.camera import Camera
from gtsam_rwhec.vision.edges import refine_corners
from gtsam_rwhec.vision.images import Gray
from gtsam_rwhec.vision.rejection import Rejection
from gtsam_rwhec.vision.tag_agreement import agreeing_in_space, plane_coordinates
from gtsam_rwhec.vision.tag_boards import Bundle, TagGrid
from gtsam_rwhec.vision.targets import Charuco, Tag, Target

#: The note on a ChArUco board of this pattern.
LEGACY = "printed in the pattern of OpenCV before 4.6, and read so"
#: Ids of n tags, and their corners (n, 4, 2), pixels.
Tags: TypeAlias = tuple[list[int], Array]


@dataclass(frozen=True, eq=False)
class Sighting:
    """A target's corners before its pose; fields as in `Detection`."""

    target: Target
    indices: np.ndarray
    corners_px: Array
    blur_px: float = np.nan
    rejection: Rejection | None = None
    note: str = ""


@dataclass(frozen=True, eq=False)
class Seeing:
    """What corners are measured with: images of a camera, modules along a tag's side, the most blur (pixels)."""

    images: Sequence[Gray]
    camera: Camera
    modules: int
    max_blur_px: float


def of_single_tags(seeing: Seeing, tags: Mapping[int, Tag], found: Sequence[Tags]) -> Iterator[tuple[int, Sighting]]:
    """Sightings of targets that are single tags, by id, with the numbers of their images."""
    mine = [(k, j) for k, (ids, _) in enumerate(found) for j, i in enumerate(ids) if i in tags]
    if not mine:
        return
    rough = np.array([found[k][1][j] for k, j in mine])
    image_of = np.array([k for k, _ in mine])
    refined = refine_corners(seeing.images, image_of, rough, seeing.camera, seeing.modules)
    for (k, j), at_first, sharp, blur in zip(mine, rough, refined.corners_px, refined.blur_px.tolist(), strict=True):
        ids = found[k][0]
        rejection = Rejection.SEEN_TWICE if ids.count(ids[j]) > 1 else None
        if not np.isfinite(sharp).all():
            rejection, sharp = rejection or Rejection.NO_EDGES, at_first
        elif blur > seeing.max_blur_px:
            rejection = rejection or Rejection.BLURRED
        yield k, Sighting(tags[ids[j]], np.arange(4), sharp, blur, rejection)


def of_boards(seeing: Seeing, tag_boards: Iterable[TagBoard], found: Sequence[Tags]) -> Iterator[tuple[int, Sighting]]:
    """Sightings of boards of tags, with the numbers of their images."""
    from_edges: list[tuple[int, Bundle | TagGrid, BoardTags]] = []
    for board in tag_boards:
        for k, (ids, corners) in enumerate(found):
            mine = [j for j, i in enumerate(ids) if i in board.ids]
            if not mine:
                continue
            tags = tags_of_board(board, np.array([ids[j] for j in mine]), corners[mine], seeing.camera)
            if tags.contradicted:
                yield k, _contradicted(board, tags)
            elif isinstance(board, (TagGrid, Bundle)):
                if len(tags.ids):
                    from_edges.append((k, board, tags))
            else:
                indices, seen = boards.board_corners(seeing.images[k], board, tags, seeing.camera)
                if len(indices):
                    yield k, Sighting(board, indices, seen, note=LEGACY if tags.is_legacy else "")
    yield from _by_edges(seeing, from_edges)


def _contradicted(board: TagBoard, tags: BoardTags) -> Sighting:
    """Tags that are not where their board has them; of a ChArUco board they are no corners."""
    indices = np.zeros(0, dtype=int) if isinstance(board, Charuco) else _corner_indices(board, tags.ids)
    seen = tags.corners_px.reshape(-1, 2)[: len(indices)]
    return Sighting(board, indices, seen, rejection=Rejection.LAYOUT, note=tags.note)


def _by_edges(
    seeing: Seeing, boards_seen: list[tuple[int, Bundle | TagGrid, BoardTags]]
) -> Iterator[tuple[int, Sighting]]:
    """Sightings of boards whose corners come from the edges of their tags."""
    if not boards_seen:
        return
    image_of = np.concatenate([np.full(len(tags.ids), k) for k, _, tags in boards_seen])
    rough = np.concatenate([tags.corners_px for _, _, tags in boards_seen])
    refined = refine_corners(seeing.images, image_of, rough, seeing.camera, seeing.modules)
    start = 0
    for k, board, tags in boards_seen:
        mine = slice(start, start + len(tags.ids))
        start = mine.stop
        yield k, _of_edges(seeing, board, tags.ids, refined.corners_px[mine], refined.blur_px[mine])


def _of_edges(seeing: Seeing, board: Bundle | TagGrid, ids: np.ndarray, sharp: Array, blur: Array) -> Sighting:
    """A sighting from the corners (m, 4, 2) of a board's tags; nan where the edges were not found."""
    good = np.isfinite(sharp).all(axis=(1, 2))
    if not good.any():
        return Sighting(board, np.zeros(0, dtype=int), np.zeros((0, 2)), rejection=Rejection.NO_EDGES)
    ids, sharp = ids[good], sharp[good]
    indices, corners = _corner_indices(board, ids), sharp.reshape(-1, 2)
    places = tag_places(board)[indices[::4] // 4]
    kept = np.ones(len(corners), dtype=bool)
    if isinstance(board, TagGrid):
        kept = boards.on_one_plane(seeing.camera, board.corners()[indices], corners)
    elif len(ids) > 2 and plane_coordinates(places) is None:
        x, focal = seeing.camera.undistort(sharp), seeing.camera.focal_px
        agrees = np.repeat(agreeing_in_space(places, x, np.full(len(ids), boards.ASTRAY_PX / focal)), 4)
        kept = agrees if agrees.sum() >= 8 else kept
    usual = float(np.median(blur[good]))
    rejection = Rejection.BLURRED if usual > seeing.max_blur_px else None
    return Sighting(board, indices[kept], corners[kept], usual, rejection)


def _corner_indices(board: TagBoard, ids: np.ndarray) -> np.ndarray:
    """Numbers (4 m,) of the corners of a board's tags (m,)."""
    number = {i: n for n, i in enumerate(board.ids)}
    of_board = np.array([number[int(i)] for i in ids], dtype=int)
    return np.asarray((4 * of_board[:, None] + np.arange(4)).ravel())
