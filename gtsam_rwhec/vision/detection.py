"""Detection of targets in images: corners, poses, and the reason why a detection is not used."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np

from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.vision import boards
from gtsam_rwhec.vision.camera import Camera
from gtsam_rwhec.vision.checkerboards import find_checkerboard
from gtsam_rwhec.vision.circle_grids import find_circle_grid
from gtsam_rwhec.vision.codes import identified, quadrangles, unlike
from gtsam_rwhec.vision.dictionaries import detector_of, modules
from gtsam_rwhec.vision.edges import refine_corners
from gtsam_rwhec.vision.images import Gray
from gtsam_rwhec.vision.options import DetectionOptions
from gtsam_rwhec.vision.pose import PlanePoses, plane_poses
from gtsam_rwhec.vision.rejection import Rejection
from gtsam_rwhec.vision.targets import AprilGrid, Charuco, Checkerboard, CircleGrid, Tag, Target

#: Family of tags, and the modules of their border.
_Kind: TypeAlias = tuple[str, int]
#: Ids of n tags, and their corners (n, 4, 2), pixels.
_Tags: TypeAlias = tuple[list[int], Array]


@dataclass(frozen=True, eq=False)
class Detection:
    """A target in an image.

    Attributes
    ----------
    target : str
        Name of the target.
    corners_px : (n, 2) array
        The corners that were seen, pixels.
    indices : (n,) integers
        Rows of these corners in ``Target.corners``.
    T : (2, 4, 4) array
        T_camera_target, metres: a plane's two candidates, the candidate of smaller reprojection error first; nan where
        a candidate is missing.
    squared_px : (2,) array
        Sum of squared reprojection errors, px^2.
    reprojection_px : (2,) array
        Root mean square of the reprojection errors, pixels.
    covariance : (2, 6, 6) array
        Covariance of the right perturbation [omega (rad), v (m)], from corner noise.
    side_px : float
        The shortest side of a tag, or of a board's bounding box, pixels.
    blur_px : float
        Standard deviation of the blur across a tag's edges, pixels; nan for boards.
    rejection : Rejection or None
        Why the detection is not used; None if it is used.
    """

    target: str
    corners_px: Array
    indices: np.ndarray
    T: Array
    squared_px: Array
    reprojection_px: Array
    covariance: Array
    side_px: float
    blur_px: float
    rejection: Rejection | None = None


@dataclass(frozen=True)
class ImageDetections:
    """The targets detected in one image, and the number of tags that belong to no target, by family and id."""

    detections: tuple[Detection, ...]
    strangers: dict[tuple[str, int], int]


@dataclass(frozen=True, eq=False)
class _Sighting:
    """A target's corners before its pose."""

    target: Target
    indices: np.ndarray
    corners_px: Array
    blur_px: float = np.nan
    rejection: Rejection | None = None


class Detector:
    """Finds a camera's targets in its images. Two threads must not use one detector at once.

    Parameters
    ----------
    camera : Camera
    targets : sequence of Target
    options : DetectionOptions
    """

    def __init__(self, camera: Camera, targets: Sequence[Target], options: DetectionOptions | None = None) -> None:
        self.camera = camera
        self.options = DetectionOptions() if options is None else options
        self._owners = {(*_kind(t), i) for t in targets for i in t.ids}
        kinds = sorted({_kind(target) for target in targets if target.ids})
        self._ids = {kind: sorted(i for *of, i in self._owners if tuple(of) == kind) for kind in kinds}
        #: Each border has one detector, since OpenCV looks for several families at once.
        self._detectors = {
            border: detector_of({family: ids for (family, b), ids in self._ids.items() if b == border}, border)
            for border in sorted({border for _, border in kinds})
        }
        self._tags = {(*_kind(t), t.id): t for t in targets if isinstance(t, Tag)}
        self._boards = [t for t in targets if isinstance(t, (Charuco, AprilGrid))]
        self._checkerboards = [t for t in targets if isinstance(t, Checkerboard)]
        self._circle_grids = [t for t in targets if isinstance(t, CircleGrid)]
        self._charuco = {t.name: boards.charuco_detector(t) for t in targets if isinstance(t, Charuco)}

    def __call__(self, images: Sequence[Gray]) -> list[ImageDetections]:
        """Detect targets in images (height, width) of 8 bits.

        Many images at once take less time: their edges and poses are refined together.
        """
        sightings: list[list[_Sighting]] = [[] for _ in images]
        tags = self._tags_in(images)
        for kind, found in tags.items():
            for board in (board for board in self._boards if _kind(board) == kind):
                for of_image, gray, (ids, corners) in zip(sightings, images, found, strict=True):
                    indices, seen_px = self._board(gray, board, ids, corners)
                    if len(indices):
                        kept = boards.on_one_plane(self.camera, board.corners()[indices], seen_px)
                        of_image.append(_Sighting(board, indices[kept], seen_px[kept]))
            for k, sighting in self._single_tags(images, kind, found):
                sightings[k].append(sighting)
        for checkerboard in self._checkerboards:
            for of_image, gray in zip(sightings, images, strict=True):
                seen = find_checkerboard(gray, checkerboard, self.camera)
                if seen is not None:
                    of_image.append(_Sighting(checkerboard, seen.indices, seen.corners_px, rejection=seen.rejection))
        for circle_grid in self._circle_grids:
            for of_image, gray in zip(sightings, images, strict=True):
                circles = find_circle_grid(gray, circle_grid, self.camera)
                if circles is not None:
                    of_image.append(
                        _Sighting(circle_grid, circles.indices, circles.corners_px, rejection=circles.rejection)
                    )
        judged = iter(self._judged([sighting for of_image in sightings for sighting in of_image]))
        return [
            ImageDetections(tuple(next(judged) for _ in of_image), strangers)
            for of_image, strangers in zip(sightings, self._strangers(images, tags), strict=True)
        ]

    def _tags_in(self, images: Sequence[Gray]) -> dict[_Kind, list[_Tags]]:
        """Find the targets' tags of each kind in each image, with corners right to about a pixel."""
        tags: dict[_Kind, list[_Tags]] = {kind: [] for kind in self._ids}
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

    def _strangers(
        self, images: Sequence[Gray], tags: dict[_Kind, list[_Tags]]
    ) -> Iterator[dict[tuple[str, int], int]]:
        """Count the tags in each image that have a target's family but belong to no target, by family and id."""
        for k, gray in enumerate(images):
            quads = quadrangles(gray) if tags else np.zeros((0, 4, 2))
            quads = unlike(quads, np.concatenate([quads[:0], *(found[k][1] for found in tags.values())]))
            strange: Counter[tuple[str, int]] = Counter()
            for kind in tags:
                ids = identified(gray, quads, *kind)
                strange.update((kind[0], int(i)) for i in ids[ids >= 0] if (*kind, int(i)) not in self._owners)
            yield dict(strange)

    def _single_tags(self, images: Sequence[Gray], kind: _Kind, found: list[_Tags]) -> Iterator[tuple[int, _Sighting]]:
        """Sightings of targets that are single tags, with the numbers of their images."""
        mine = [(k, j) for k, (ids, _) in enumerate(found) for j, i in enumerate(ids) if (*kind, i) in self._tags]
        if not mine:
            return
        rough = np.array([found[k][1][j] for k, j in mine])
        image_of = np.array([k for k, _ in mine])
        refined = refine_corners(images, image_of, rough, self.camera, modules(*kind))
        for (k, j), at_first, sharp, blur in zip(
            mine, rough, refined.corners_px, refined.blur_px.tolist(), strict=True
        ):
            ids = found[k][0]
            rejection = Rejection.SEEN_TWICE if ids.count(ids[j]) > 1 else None
            if not np.isfinite(sharp).all():
                rejection, sharp = rejection or Rejection.NO_EDGES, at_first
            elif blur > self.options.max_blur_px:
                rejection = rejection or Rejection.BLURRED
            yield k, _Sighting(self._tags[(*kind, ids[j])], np.arange(4), sharp, blur, rejection)

    def _board(self, gray: Gray, board: Target, ids: list[int], corners: Array) -> tuple[np.ndarray, Array]:
        mine = [k for k, i in enumerate(ids) if i in board.ids]
        numbers = np.array([ids[k] for k in mine], dtype=int)
        if isinstance(board, Charuco):
            return boards.charuco_corners(gray, board, self._charuco[board.name], numbers, corners[mine])
        assert isinstance(board, AprilGrid)
        return boards.aprilgrid_corners(gray, board, numbers, corners[mine])

    def _judged(self, sightings: list[_Sighting]) -> list[Detection]:
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

    def _detection(self, sighting: _Sighting, poses: PlanePoses, k: int) -> Detection:
        """The detection of a sighting, whose pose is number k of `poses`."""
        T, rms = poses.T[k], poses.reprojection_px[k]
        side = _shortest_side(sighting.target, sighting.corners_px)
        return Detection(
            sighting.target.name, sighting.corners_px, sighting.indices, T, poses.squared_px[k], rms,
            poses.covariance[k], side, float(sighting.blur_px),
            sighting.rejection or self._rejection(sighting, side, T[0], float(rms[0])),
        )  # fmt: skip

    def _rejection(self, sighting: _Sighting, side_px: float, T: Array, rms_px: float) -> Rejection | None:
        options = self.options
        if not isinstance(sighting.target, Tag) and len(sighting.corners_px) < options.min_corners:
            return Rejection.FEW_CORNERS
        if side_px < options.min_side_px:
            return Rejection.SMALL
        if not np.isfinite(rms_px):
            return Rejection.NO_POSE
        if rms_px > options.max_reprojection_px:
            return Rejection.REPROJECTION
        return Rejection.GRAZING if grazing_rad(T) > np.radians(options.max_grazing_deg) else None


def grazing_rad(T_camera_target: Array) -> float:
    """The angle between the line of sight to a target's origin and the target's normal; it is 0 from the front."""
    t = T_camera_target[:3, 3]
    cosine = -float(T_camera_target[:3, 2] @ t) / float(np.linalg.norm(t))
    return float(np.arccos(np.clip(cosine, -1.0, 1.0)))


def _kind(target: Target) -> _Kind:
    """Family and border of a target's tags."""
    return target.family, 2 if isinstance(target, AprilGrid) else 1


def _shortest_side(target: Target, corners: Array) -> float:
    if isinstance(target, Tag):
        return float(np.linalg.norm(np.roll(corners, -1, axis=0) - corners, axis=1).min())
    return float(np.ptp(corners, axis=0).min())
