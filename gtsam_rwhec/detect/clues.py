"""What an image says about a target that was not read in it: another target, or an image that is not good enough.

Each clue was seen: another size or family is a clue where the target so changed is read in the image, too much blur
where the target is read in a smaller image, too little light where it is read in a brightened one. What cannot be tried
is no clue.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from enum import Enum

import cv2
import numpy as np

from gtsam_rwhec.cameras.camera import Camera
from gtsam_rwhec.cameras.targets import CORNERS, AprilGrid, Checkerboard, CircleGrid, Tag, Target, is_same_print
from gtsam_rwhec.detect.detections import DetectionOptions
from gtsam_rwhec.detect.detector import Detection, Detector
from gtsam_rwhec.detect.images import Gray
from gtsam_rwhec.detect.saddle_lattices import lattice_sizes
from gtsam_rwhec.detect.tags import BY_TRUST, DOUBLE, identified, quadrangles, tags_in_image, unlike
from gtsam_rwhec.errors import TargetError
from gtsam_rwhec.geometry.poses import Array

#: Gray values from which a pixel is saturated.
SATURATED = 253
#: An image is smoothed by the first standard deviation (pixels) against its noise, and blurred by the second, to see
#: how much that changes its edges; with the second pair where they are wider than `WIDE_PX`.
AGAIN_PX, WIDE_PX = ((0.7, 1.5), (2.0, 4.0)), 1.8
#: The strongest edges that are looked at, as a share of the pixels, and their gradient at least (gray values a pixel).
EDGES, LEAST_GRADIENT = 0.003, 2.0
#: Edges are looked at by this number of directions, each where it has this number of them.
DIRECTIONS, FEWEST_EDGES = 8, 40
#: A brightened image goes from black to white between these percentiles of its gray values.
DARKEST, BRIGHTEST = 0.5, 99.7


def edge_blur_px(gray: Gray) -> float:
    """The standard deviation of the blur across an image's strongest edges, pixels; nan without any.

    Of a step that is blurred by s, a blur by s0 more lowers the gradient in its middle by R = sqrt(1 + s0^2 / s^2)
    (Zhuo and Sim 2011, equation 5). Wide edges are measured again with a larger s0, which noise disturbs less.
    """
    blur_px = _edge_blur_px(gray, AGAIN_PX[0])
    return _edge_blur_px(gray, AGAIN_PX[1]) if blur_px > WIDE_PX else blur_px


def motion_blur_px(gray: Gray) -> tuple[float, float]:
    """The blur of edges by their direction, where it is widest and where it is narrowest (pixels); nan without both.

    The standard deviation as in `edge_blur_px`, of edges by their direction: what moves blurs the edges across its way,
    and leaves those along it sharp. A lens that is out of focus blurs all alike.
    """
    gradients, ratios, directions = _edges(gray, AGAIN_PX[0])
    number = np.rint(directions / np.pi * DIRECTIONS).astype(int) % DIRECTIONS
    found = []
    for of_these in (number == direction for direction in range(DIRECTIONS)):
        if of_these.sum() >= FEWEST_EDGES:
            some = of_these & (gradients >= np.median(gradients[of_these]))
            found.append(_blur_px(ratios[some], AGAIN_PX[0]))
    return (max(found), min(found)) if len(found) > 1 else (float("nan"), float("nan"))


def _edges(gray: Gray, by_px: tuple[float, float]) -> tuple[Array, Array, Array]:
    """Gradients (n,) on edges, by how much (n,) more blur lowers them, and the edges' directions (n,), 0 to pi."""
    smooth = cv2.GaussianBlur(np.asarray(gray, dtype=np.float32), (0, 0), by_px[0])
    (x, y), (x_again, y_again) = (
        [cv2.Sobel(values, cv2.CV_32F, *order, ksize=3, scale=0.125) for order in ((1, 0), (0, 1))]
        for values in (smooth, cv2.GaussianBlur(smooth, (0, 0), by_px[1]))
    )
    first = np.asarray(cv2.magnitude(x, y), dtype=np.float32)
    second = np.asarray(cv2.magnitude(x_again, y_again), dtype=np.float32)
    peak = (first >= cv2.dilate(first, np.ones((3, 3), np.uint8))) & (first >= LEAST_GRADIENT)
    return first[peak], first[peak] / np.maximum(second[peak], 1e-6), np.arctan2(y[peak], x[peak]) % np.pi


def _edge_blur_px(gray: Gray, by_px: tuple[float, float]) -> float:
    gradients, ratios, _ = _edges(gray, by_px)
    if len(gradients) < 20:
        return float("nan")
    least = np.sort(gradients)[-max(20, round(EDGES * gray.size)) :][0]
    return _blur_px(ratios[gradients >= least], by_px)


def _blur_px(ratios: Array, by_px: tuple[float, float]) -> float:
    """Edge blur (pixels) from ratios of gradients before and after more blur, less the first smoothing `by_px[0]`."""
    ratio = max(float(np.median(ratios)), 1.01)
    return float(np.sqrt(max(by_px[1] ** 2 / (ratio**2 - 1.0) - by_px[0] ** 2, 0.0)))


def brightened(gray: Gray) -> Gray:
    """The image with its gray values stretched from black to white, after a little blur against its noise."""
    smooth = cv2.GaussianBlur(gray.astype(np.float32), (0, 0), 1.0)
    low, high = np.percentile(smooth[::2, ::2], (DARKEST, BRIGHTEST))
    light: Gray = np.clip(np.rint(255.0 * (smooth - low) / max(high - low, 1.0)), 0, 255).astype(np.uint8)
    return light


def folded(gray: Gray, level: float) -> Gray:
    """How far gray values are from a level, eight times as far: what is darker and what is lighter become light.

    A black square on ground that is nearly as dark gets a light margin where the level is the square's own.
    """
    smooth = cv2.GaussianBlur(gray.astype(np.float32), (0, 0), 1.0)
    apart: Gray = np.clip(8.0 * np.abs(smooth - level), 0.0, 255.0).astype(np.uint8)
    return apart


def resized(gray: Gray, camera: Camera, scale: float) -> tuple[Gray, Camera]:
    """An image of another number of pixels, and its camera."""
    height, width = (max(1, round(scale * n)) for n in gray.shape)
    way = cv2.INTER_AREA if scale < 1.0 else cv2.INTER_CUBIC
    K = camera.K.copy()
    for row, factor in enumerate((width / camera.width, height / camera.height)):  # pixel centres are at whole numbers
        K[row, :2] *= factor
        K[row, 2] = factor * (K[row, 2] + 0.5) - 0.5
    smaller = np.asarray(cv2.resize(gray, (width, height), interpolation=way), dtype=np.uint8)
    return smaller, replace(camera, width=width, height=height, K=K)


#: A checkerboard has at most this number of corners each way.
MOST_COUNTED = 30
#: Percentiles of gray values that may be a tag's black.
LEVELS = (2.0, 8.0, 20.0, 40.0, 60.0)
#: An image of which this share is saturated is overexposed.
TOO_BRIGHT = 0.25
#: An image is made smaller by these factors to see whether blur is what hides a target, and larger by these.
SMALLER, LARGER = (0.5, 0.25), (2.0, 3.0)
#: An enlarged image has at most this number of pixels.
LARGEST_ENLARGED = 9_000_000
#: The brightest pixels of an image that may be too dark are below this gray value.
TOO_DARK = 128.0
#: Edges that are no wider than this (standard deviation, pixels) are sharp.
SHARP_PX = 1.5


class About(Enum):
    """What a clue is about. The value says what its `Clue.value` is."""

    COUNTS = "the board's counts, (across, down)"
    DOT = "where the larger dot is, a word of `CORNERS` or empty for none"
    FAMILY = "the tags' family"
    ID = "the tag's id"
    BORDER = "the modules of the tags' black border"
    MARGIN = "nothing: the ground beside the black square is as dark"
    SMALL = "nothing; the figure is the length of its shortest side, pixels"
    BLURRED = "nothing; the figure is the edges' blur, pixels"
    DARK = "nothing; the figure is the gray value of the brightest pixels"
    BRIGHT = "nothing; the figure is the saturated share"


@dataclass(frozen=True)
class Clue:
    """One thing that an image says about a target that was not read."""

    about: About
    value: tuple[int, int] | str | int | None = None
    figure: float = float("nan")


def clues(
    gray: Gray, target: Target, camera: Camera, options: DetectionOptions, is_late: Callable[[], bool] = lambda: False
) -> list[Clue]:
    """What an image says about a target that was not read in it: clues of one kind, the surest.

    Another target is surer than what is wrong with the image. Nothing more is tried when `is_late` says so.
    """
    for attempt in (_another_target, _too_small, _too_dark, _blurred, _no_margin, _too_bright):
        if is_late():
            break
        found = list(attempt(gray, target, camera, options))
        if found:
            return found
    return []


def _another_target(gray: Gray, target: Target, camera: Camera, options: DetectionOptions) -> Iterator[Clue]:
    if isinstance(target, Checkerboard):
        return _other_board(gray, target, camera, options)
    if isinstance(target, CircleGrid):
        return _other_grid(gray, target, camera, options)
    return _other_tags(gray, target)


def _too_small(gray: Gray, target: Target, camera: Camera, options: DetectionOptions) -> Iterator[Clue]:
    for scale in LARGER:
        if gray.size * scale**2 <= LARGEST_ENLARGED:
            seen = read(*resized(gray, camera, scale), target, options)
            if seen is not None:
                yield Clue(About.SMALL, figure=seen.side_px / scale)
                return


def _too_dark(gray: Gray, target: Target, camera: Camera, options: DetectionOptions) -> Iterator[Clue]:
    value = float(np.percentile(gray[::2, ::2], BRIGHTEST))
    if value < TOO_DARK and read(brightened(gray), camera, target, options) is not None:
        yield Clue(About.DARK, figure=value)


def _blurred(gray: Gray, target: Target, camera: Camera, options: DetectionOptions) -> Iterator[Clue]:
    blur_px = edge_blur_px(gray)
    if blur_px > SHARP_PX:
        light = brightened(gray)
        if any(read(*resized(light, camera, scale), target, options) is not None for scale in SMALLER):
            yield Clue(About.BLURRED, figure=blur_px)


def _no_margin(gray: Gray, target: Target, *_: object) -> Iterator[Clue]:
    """A tag of the target is read once what is as dark as its black is told from it."""
    border = 2 if isinstance(target, AprilGrid) else 1
    for level in np.percentile(gray[::2, ::2], LEVELS) if target.ids else ():
        apart = folded(gray, float(level))
        ids = identified(apart, unlike(quadrangles(apart), np.zeros((0, 4, 2))), target.family, border)
        if set(ids.tolist()) & set(target.ids):
            yield Clue(About.MARGIN)
            return


def _too_bright(gray: Gray, *_: object) -> Iterator[Clue]:
    saturated_share = float((gray >= SATURATED).mean())
    if saturated_share >= TOO_BRIGHT:
        yield Clue(About.BRIGHT, figure=saturated_share)


def read(gray: Gray, camera: Camera, target: Target, options: DetectionOptions) -> Detection | None:
    """A target as it is read, and not rejected."""
    (seen,) = Detector(camera, [target], options)([gray])
    return next((detection for detection in seen.detections if detection.rejection is None), None)


def _other_board(gray: Gray, board: Checkerboard, camera: Camera, options: DetectionOptions) -> Iterator[Clue]:
    """The counts of the checkerboard that is in the image, in the order of the one that was looked for."""
    stated = (min(board.columns, board.rows), max(board.columns, board.rows))
    for size in dict.fromkeys((min(size), max(size)) for size in lattice_sizes(gray)):
        counts = size if board.columns <= board.rows else size[::-1]
        if size == stated or size[0] < 3 or size[1] > MOST_COUNTED:
            continue
        if read(gray, camera, replace(board, columns=counts[0], rows=counts[1]), options) is not None:
            yield Clue(About.COUNTS, counts)
            return


def _other_grid(gray: Gray, grid: CircleGrid, camera: Camera, options: DetectionOptions) -> Iterator[Clue]:
    """Another place of the larger dot, none or one; then other numbers of circles."""
    c, r = grid.columns, grid.rows
    if c != r and read(gray, camera, replace(grid, columns=r, rows=c), options) is not None:
        yield Clue(About.COUNTS, (r, c))  # as likely as another place of the dot, and the commoner mistake
        return
    for dot in (*CORNERS, ""):
        if grid.asymmetric or dot == grid.corner:  # an asymmetric grid has no larger dot
            continue
        if read(gray, camera, replace(grid, larger_dot=dot or False), options) is not None:
            yield Clue(About.DOT, dot)
            return
    others = [(c + i, r + j) for i in (-1, 0, 1) for j in (-1, 0, 1) if (i, j) != (0, 0)]
    others += [(b + i, a + j) for a, b in [(c, r)] * (r != c) for i, j in ((1, 0), (0, 1), (-1, 0), (0, -1))]
    for columns, rows in others:
        try:
            other = replace(grid, columns=columns, rows=rows)
        except TargetError:
            continue
        if read(gray, camera, other, options) is not None:
            yield Clue(About.COUNTS, (columns, rows))
            return


def tags_seen(gray: Gray) -> list[tuple[str, int, int]]:
    """Family, border in modules (0: not known) and id of the tags of all families in an image, each place once."""
    quads = quadrangles(gray)
    quads = unlike(quads, quads[:0])
    found: list[tuple[str, int, int]] = []
    for family in BY_TRUST:
        for border in (2, 1) if family == DOUBLE else (1,):
            ids = identified(gray, quads, family, border)
            found += [(family, border, int(i)) for i in ids[ids >= 0]]
            quads = quads[ids < 0]
    if not found:  # squares that touch the tags' corners, as on AprilGrids, hide quadrangles
        found = [(DOUBLE, 2 if tag.is_double else 0, tag.id) for tag in tags_in_image(gray, [DOUBLE])]
    return found


def _other_tags(gray: Gray, target: Target) -> Iterator[Clue]:
    """Another family, another border, or for a single tag another id."""
    border = 2 if isinstance(target, AprilGrid) else 1
    seen = tags_seen(gray)
    mine = [(family, b, i) for family, b, i in seen if is_same_print(family, target.family)]
    if mine:
        if all(b not in (0, border) for _, b, _ in mine):
            yield Clue(About.BORDER, mine[0][1])
        elif isinstance(target, Tag):
            for _, _, number in mine:
                if number != target.id:
                    yield Clue(About.ID, number)
        return
    several = 1 if isinstance(target, Tag) else 2
    for family in dict.fromkeys(family for family, _, _ in seen):
        ids = [i for of, _, i in seen if of == family]
        if len(ids) >= several:
            yield Clue(About.FAMILY, family)
