"""Detection of targets in images: corners, poses, and the reason why a detection is not used.

Tags of boards count only where their board has them (`board_layout`). Corners of single tags, grids of tags and bundles
come from the tags' edges, many tags of many images at once; those of ChArUco boards and AprilGrids are points where two
dark squares meet.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np

from gtsam_rwhec.cameras.camera import Camera
from gtsam_rwhec.cameras.target_poses import PlanePoses, plane_poses
from gtsam_rwhec.cameras.targets import AprilGrid, Bundle, Charuco, Checkerboard, CircleGrid, Tag, TagGrid, Target
from gtsam_rwhec.detect import board_corners as boards
from gtsam_rwhec.detect.board_corners import board_corners
from gtsam_rwhec.detect.board_layout import (
    BoardTags,
    TagBoard,
    agreeing_in_space,
    plane_coordinates,
    tag_places,
    tags_of_board,
)
from gtsam_rwhec.detect.checkerboards import find_checkerboard
from gtsam_rwhec.detect.circle_grids import find_circle_grid
from gtsam_rwhec.detect.detections import Detection as Detection
from gtsam_rwhec.detect.detections import DetectionOptions, Rejection
from gtsam_rwhec.detect.detections import ImageDetections as ImageDetections
from gtsam_rwhec.detect.images import Gray
from gtsam_rwhec.detect.tag_edges import refine_corners
from gtsam_rwhec.detect.tags import detector_of, identified, modules, quadrangles, unlike
from gtsam_rwhec.geometry.poses import Array

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
                indices, seen = board_corners(seeing.images[k], board, tags, seeing.camera)
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


#: Family of tags, and the modules of their border.
_Kind: TypeAlias = tuple[str, int]


class Detector:
    """Finds a camera's targets in its images. Two threads must not use one detector at once."""

    def __init__(self, camera: Camera, targets: Sequence[Target], options: DetectionOptions | None = None) -> None:
        self.camera = camera
        self.options = DetectionOptions() if options is None else options
        self._owners = {(*_kind(t), i) for t in targets for i in t.ids}
        kinds = sorted({_kind(target) for target in targets if target.ids})
        self._ids = {kind: sorted(i for *of, i in self._owners if tuple(of) == kind) for kind in kinds}
        #: Each border has one detector, since OpenCV looks for several families at once.
        self._detectors = {
            border: detector_of(
                {family: ids for (family, b), ids in self._ids.items() if b == border},
                border,
                larger_side_px=max(camera.width, camera.height),
            )
            for border in sorted({border for _, border in kinds})
        }
        self._tags = [t for t in targets if isinstance(t, Tag)]
        self._boards: list[TagBoard] = [t for t in targets if isinstance(t, (Charuco, AprilGrid, TagGrid, Bundle))]
        self._checkerboards = [t for t in targets if isinstance(t, Checkerboard)]
        self._circle_grids = [t for t in targets if isinstance(t, CircleGrid)]

    def __call__(self, images: Sequence[Gray]) -> list[ImageDetections]:
        """Detect targets in images (height, width) of 8 bits.

        Many images at once take less time: their edges and poses are refined together.
        """
        sightings: list[list[Sighting]] = [[] for _ in images]
        tags = self._tags_in(images)
        for kind, found in tags.items():
            seeing = Seeing(images, self.camera, modules(*kind), self.options.max_blur_px)
            of_kind = [board for board in self._boards if _kind(board) == kind]
            single = {tag.id: tag for tag in self._tags if _kind(tag) == kind}
            for k, sighting in (*of_boards(seeing, of_kind, found), *of_single_tags(seeing, single, found)):
                sightings[k].append(sighting)
        for checkerboard in self._checkerboards:
            for of_image, gray in zip(sightings, images, strict=True):
                seen = find_checkerboard(gray, checkerboard, self.camera)
                if seen is not None:
                    of_image.append(Sighting(checkerboard, seen.indices, seen.corners_px, rejection=seen.rejection))
        for circle_grid in self._circle_grids:
            for of_image, gray in zip(sightings, images, strict=True):
                circles = find_circle_grid(gray, circle_grid, self.camera)
                if circles is not None:
                    of_image.append(
                        Sighting(circle_grid, circles.indices, circles.corners_px, rejection=circles.rejection)
                    )
        judged = iter(self._judged([sighting for of_image in sightings for sighting in of_image]))
        return [
            ImageDetections(tuple(next(judged) for _ in of_image), strangers)
            for of_image, strangers in zip(sightings, self._strangers(images, tags), strict=True)
        ]

    def _tags_in(self, images: Sequence[Gray]) -> dict[_Kind, list[Tags]]:
        """Find the targets' tags of each kind in each image, with corners right to about a pixel."""
        tags: dict[_Kind, list[Tags]] = {kind: [] for kind in self._ids}
        for gray in images:
            for border, detector in self._detectors.items():
                quads, places, _, families = detector.detectMarkersMultiDict(gray)
                corners = np.array(quads, dtype=float).reshape(-1, 4, 2)
                place_of = np.ravel(places if len(quads) else []).astype(int)
                family_of = np.ravel(families if len(quads) else []).astype(int)
                kinds = [kind for kind in self._ids if kind[1] == border]
                for number, kind in enumerate(kinds):
                    mine = np.flatnonzero(family_of == number)
                    tags[kind].append(([self._ids[kind][i] for i in place_of[mine]], corners[mine]))
        return tags

    def _strangers(self, images: Sequence[Gray], tags: dict[_Kind, list[Tags]]) -> Iterator[dict[tuple[str, int], int]]:
        """Count the tags in each image that have a target's family but belong to no target, by family and id."""
        for k, gray in enumerate(images):
            quads = quadrangles(gray) if tags else np.zeros((0, 4, 2))
            quads = unlike(quads, np.concatenate([quads[:0], *(found[k][1] for found in tags.values())]))
            strange: Counter[tuple[str, int]] = Counter()
            none_seen = not any(found[k][0] for found in tags.values())
            for kind in tags:
                ids = identified(gray, quads, *kind)
                strange.update((kind[0], int(i)) for i in ids[ids >= 0] if (*kind, int(i)) not in self._owners)
                if none_seen:
                    ids = identified(gray, quads[:, ::-1], *kind)
                    strange.update((f"mirrored {kind[0]}", int(i)) for i in ids if (*kind, int(i)) in self._owners)
            yield dict(strange)

    def _judged(self, sightings: list[Sighting]) -> list[Detection]:
        """Detections with poses: all tags together, then all boards together, which have more corners."""
        result: dict[int, Detection] = {}
        for of_tags in (True, False):
            places = [i for i, s in enumerate(sightings) if isinstance(s.target, Tag) == of_tags]
            poses = plane_poses(
                self.camera,
                [sightings[i].target.corners()[sightings[i].indices] for i in places],
                [sightings[i].corners_px for i in places],
                corner_px=self.options.corner_px,
            )
            result |= {i: self._detection(sightings[i], poses, k) for k, i in enumerate(places)}
        return [result[i] for i in range(len(sightings))]

    def _detection(self, sighting: Sighting, poses: PlanePoses, k: int) -> Detection:
        """The detection of a sighting, whose pose is number k of `poses`."""
        T, rms = poses.T[k], poses.reprojection_px[k]
        side = shortest_side_px(sighting.target, sighting.corners_px)
        rejection = sighting.rejection or self._rejection(sighting, side, T[0], float(rms[0]))
        if rejection and not self.camera.has_ray(sighting.corners_px).all():  # which explains all other reasons
            rejection = Rejection.NO_RAY
        return Detection(
            sighting.target.name, sighting.corners_px, sighting.indices, T, poses.squared_px[k], rms,
            poses.covariance[k], side, float(sighting.blur_px),
            rejection, sighting.note,
        )  # fmt: skip

    def _rejection(self, sighting: Sighting, side_px: float, T: Array, rms_px: float) -> Rejection | None:
        options = self.options
        if not isinstance(sighting.target, (Tag, Bundle)) and len(sighting.corners_px) < options.min_corners:
            return Rejection.FEW_CORNERS
        if side_px < options.min_side_px:
            return Rejection.SMALL
        if not np.isfinite(rms_px):
            return Rejection.NO_POSE
        if rms_px > options.max_reprojection_px:
            return Rejection.REPROJECTION
        return Rejection.GRAZING if _grazing(sighting, T) > np.radians(options.max_grazing_deg) else None


def grazing_rad(T_camera_target: Array) -> float:
    """The angle between the line of sight to a target's origin and the target's normal; it is 0 from the front."""
    t = T_camera_target[:3, 3]
    cosine = -float(T_camera_target[:3, 2] @ t) / float(np.linalg.norm(t))
    return float(np.arccos(np.clip(cosine, -1.0, 1.0)))


def _grazing(sighting: Sighting, T_camera_target: Array) -> float:
    """As `grazing_rad`; of a bundle, the angle to the tag that is seen the most from the front."""
    if not isinstance(sighting.target, Bundle):
        return grazing_rad(T_camera_target)
    angles = []
    for corners in tag_places(sighting.target)[np.unique(sighting.indices // 4)]:
        T_target_tag = np.eye(4)
        T_target_tag[:3, 2] = np.cross(corners[1] - corners[0], corners[0] - corners[3])
        T_target_tag[:3, 2] /= np.linalg.norm(T_target_tag[:3, 2])
        T_target_tag[:3, 3] = corners.mean(axis=0)
        angles.append(grazing_rad(T_camera_target @ T_target_tag))
    return min(angles)


def _kind(target: Target) -> _Kind:
    """Family and border of a target's tags."""
    return target.family, 2 if isinstance(target, AprilGrid) else 1


def shortest_side_px(target: Target, corners_px: Array) -> float:
    """The shortest side of a tag, or of the box that holds a board's seen corners (n, 2), pixels."""
    if isinstance(target, Tag):
        return float(np.linalg.norm(np.roll(corners_px, -1, axis=0) - corners_px, axis=1).min())
    return float(np.ptp(corners_px, axis=0).min()) if len(corners_px) else 0.0
