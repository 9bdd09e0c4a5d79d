"""Rendered images of each kind of target: how many are read, whether any is read wrong, how sharp the corners are.

    python tests/benchmarks/rendered_boards.py [--kinds checkerboard_3x4,circles] [--images 2000] [--jobs 2] [--seed 1]

Each image has a camera with distortion, a target at some distance, tilted by up to 70 degrees and turned, on something
textured, with shade over a part of it, blur to 1.5 pixels, motion, vignetting, gamma, and noise to 4 of 255; in a share
of them something covers a part of it. An image depends on the kind, the seed and its number alone. A target counts as
read where the detector uses it, and as misread where any of its corners is more than a pixel from the truth, in every
order that its symmetry allows. Recall is of the targets that are whole and large enough. ``--keep FOLDER`` writes what
was misread or missed. A kind is a `Kind`: add yours to `KINDS`.
"""

from __future__ import annotations

import os
import time
import zlib
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path

import cv2
import numpy as np
import rendered_prints as prints
import rendered_scenes as scenes
from bars import Row, benchmark_parser, print_rows
from binomial import Share
from loky import ProcessPoolExecutor
from rendered_prints import Array, Print
from rendered_scenes import BACKGROUNDS, Gray

from gtsam_rwhec.vision.detection import Detection, Detector
from gtsam_rwhec.vision.tag_boards import Bundle, BundleTag, TagGrid
from gtsam_rwhec.vision.targets import AprilGrid, Charuco, Checkerboard, CircleGrid, Tag, Target

#: Shares of images: with something over the target, with shade over a part of it.
COVERED, SHADED = 0.2, 0.5
#: A corner further than this from the truth is wrong.
WRONG_PX = 1.0
#: A target's outline is covered if this share of it is.
LEAST_COVERED = 0.002
#: Images of a process's piece of work.
CHUNK = 25
#: Errors are summed up along these directions.
DIRECTIONS = ("image's x", "image's y", "target's x", "target's y", "from its middle", "away from the camera")


@dataclass(frozen=True)
class Thing:
    """Something else that is printed: its print by pixels a unit and margin, the unit, and half its sides, metres."""

    draw: Callable[[int, float], Print]
    unit_m: float
    half_m: tuple[float, float]


@dataclass(frozen=True)
class Kind:
    """A kind of target.

    Attributes
    ----------
    target : Target
    draw : callable
        Of the target, the picture's pixels a unit, and the margin in units: its print.
    unit_m : float
        The unit of the drawing, metres.
    element_m, least_px : float
        What must be large enough, and its least shorter projected side: a square, a tag, a circle's cell.
    margins : pair of float
        The range of the white margin, in units.
    half_m : pair of float
        Half the sides of what must be seen, metres.
    peer : callable
        OpenCV's own detector, for its time.
    ways : int
        In how many ways the target looks the same.
    drawn : Target or None
        What is drawn in the target's place: then nothing may be read. Half the sides are its own.
    beside : tuple of Thing
        One or two of these are in each image too, the target over them.
    """

    target: Target
    draw: Callable[..., Print]
    unit_m: float
    element_m: float
    least_px: float
    margins: tuple[float, float]
    half_m: tuple[float, float]
    peer: Callable[[Gray], object]
    ways: int = 1
    drawn: Target | None = None
    beside: tuple[Thing, ...] = ()

    def outline(self) -> Array:
        """(n, 3) along the edges of what must be seen, metres."""
        return outline_of(self.half_m)

    def elements(self) -> Array:
        """(rows, columns, 3) of the corners of elements that fill what must be seen."""
        x, y = (np.linspace(-half, half, max(round(2 * half / self.element_m), 1) + 1) for half in self.half_m)
        flat = np.stack(np.meshgrid(x, y), axis=-1)
        return np.concatenate([flat, np.zeros((*flat.shape[:2], 1))], axis=-1)


def outline_of(half_m: tuple[float, float], steps: int = 12) -> Array:
    """(n, 3) along the edges of a rectangle about the origin, metres."""
    share = np.linspace(-1.0, 1.0, steps, endpoint=False)
    one = np.ones(steps)
    sides = [(share, -one), (one, share), (-share, one), (-one, -share)]
    flat = np.concatenate([np.column_stack(side) for side in sides]) * half_m
    return np.column_stack([flat, np.zeros(len(flat))])


@dataclass(frozen=True, eq=False)
class Outcome:
    """What came of one image; `sums` are of errors along `DIRECTIONS`, `squares` of errors along both axes."""

    number: int
    whole: bool
    covered: bool
    side_px: float
    refused: str | None = None
    wrong: bool = False
    corners: int = 0
    sums: Array = field(default_factory=lambda: np.zeros(len(DIRECTIONS)))
    squares: float = 0.0
    ours_s: float = 0.0
    peer_s: float = 0.0

    @property
    def is_read(self) -> bool:
        """Whether the detector uses the target."""
        return self.refused is None


def of_checkerboard(columns: int, rows: int) -> Kind:
    board = Checkerboard("board", columns, rows, 0.03)

    def classic(gray: Gray) -> object:
        flags = cv2.CALIB_CB_ADAPTIVE_THRESH | cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_FAST_CHECK
        return cv2.findChessboardCorners(gray, (columns, rows), flags=flags)

    half = (0.015 * (columns + 1), 0.015 * (rows + 1))
    return Kind(board, prints.checkerboard, 0.03, 0.03, 12.0, (0.0, 1.0), half, classic, board.ways)


def half_of(board: Checkerboard) -> tuple[float, float]:
    return 0.5 * board.square_m * (board.columns + 1), 0.5 * board.square_m * (board.rows + 1)


def in_place_of(kind: Kind, columns: int, rows: int) -> Kind:
    """A board of another size, where the rig file has this one."""
    other = Checkerboard("other", columns, rows, 0.03)
    return replace(kind, drawn=other, half_m=half_of(other), ways=1)


def things(*boards: Checkerboard) -> tuple[Thing, ...]:
    """Checkerboards, floor tiles, a ChArUco board and a keyboard."""
    charuco = Charuco("other", "aruco_4x4_100", 7, 5, 0.04, 0.03)
    tiles = Checkerboard("tiles", 24, 18, 0.015)
    keys = np.pad(np.tile(np.pad(np.ones((3, 3)), ((0, 1), (0, 1))), (5, 15)), ((1, 0), (1, 0)))
    return (
        *(Thing(partial(prints.checkerboard, board), board.square_m, half_of(board)) for board in (*boards, tiles)),
        Thing(partial(prints.charuco, charuco), 0.005, (0.14, 0.1)),
        Thing(partial(prints.drawn, keys, 0.005), 0.005, (0.0025 * keys.shape[1], 0.0025 * keys.shape[0])),
    )


def of_charuco(columns: int, rows: int) -> Kind:
    board = Charuco("board", "aruco_4x4_100", columns, rows, 0.04, 0.03)
    ids = np.arange(columns * rows // 2, dtype=np.int32)
    words = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_100)
    detector = cv2.aruco.CharucoDetector(cv2.aruco.CharucoBoard((columns, rows), 0.04, 0.03, words, ids))
    unit = board.square_m / prints.charuco_unit(board)[0]
    half = (0.02 * columns, 0.02 * rows)
    return Kind(board, prints.charuco, unit, board.square_m, 24.0, (0.0, 8.0), half, detector.detectBoard)


def _apriltags() -> Callable[[Gray], object]:
    words = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)
    return cv2.aruco.ArucoDetector(words).detectMarkers


def of_aprilgrid(columns: int, rows: int) -> Kind:
    grid = AprilGrid("grid", "tag36h11", columns, rows, 0.04, 0.3)
    half = (0.02 * (1.3 * columns + 0.3), 0.02 * (1.3 * rows + 0.3))
    return Kind(grid, prints.aprilgrid, 0.004, 0.04, 24.0, (0.0, 5.0), half, _apriltags())


def of_tag() -> Kind:
    tag = Tag("tag", "tag36h11", 7, 0.08)
    return Kind(tag, prints.single_tag, 0.01, 0.08, 24.0, (1.0, 3.0), (0.04, 0.04), _apriltags())


def of_tag_grid(columns: int, rows: int) -> Kind:
    grid = TagGrid("grid", "tag36h11", columns, rows, 0.04, 0.01)
    half = (0.025 * columns - 0.005, 0.025 * rows - 0.005)
    return Kind(grid, prints.tag_grid, 0.005, 0.04, 24.0, (1.0, 4.0), half, _apriltags())


def of_flat_bundle() -> Kind:
    places = ((-0.05, 0.05), (0.05, 0.05), (-0.05, -0.05), (0.05, -0.05), (0.0, 0.0))
    bundle = Bundle("bundle", "tag36h11", tuple(BundleTag(i, 0.04, (x, y, 0.0)) for i, (x, y) in enumerate(places)))
    return Kind(bundle, prints.flat_bundle, 0.005, 0.04, 24.0, (1.0, 4.0), (0.07, 0.07), _apriltags())


def of_circles(
    columns: int, rows: int, *, larger_dot: bool = False, asymmetric: bool = False, light: bool = False
) -> Kind:
    grid = CircleGrid("grid", columns, rows, 0.03, larger_dot, asymmetric)
    flag = cv2.CALIB_CB_ASYMMETRIC_GRID if asymmetric else cv2.CALIB_CB_SYMMETRIC_GRID

    def peer(gray: Gray) -> object:
        return cv2.findCirclesGrid(gray, (columns, rows), flags=flag)

    half = (0.015 * (2 * columns if asymmetric else columns), 0.015 * rows)
    draw = partial(prints.circle_grid, light=light)
    return Kind(grid, draw, 0.03, 0.03, 12.0, (0.0, 0.5), half, peer, grid.ways)


#: By name, what makes a kind: OpenCV's detectors are made in the process that uses them.
KINDS: dict[str, Callable[[], Kind]] = {
    "checkerboard_3x4": lambda: of_checkerboard(3, 4),
    "checkerboard_7x10": lambda: of_checkerboard(7, 10),
    "checkerboard_6x6": lambda: of_checkerboard(6, 6),
    "checkerboard_5x8": lambda: of_checkerboard(5, 8),
    "checkerboard_5x8_beside": lambda: replace(
        of_checkerboard(5, 8),
        beside=things(Checkerboard("a", 5, 7, 0.03), Checkerboard("b", 6, 8, 0.02), Checkerboard("c", 8, 6, 0.03)),
    ),
    "checkerboard_5x8_twice": lambda: replace(
        of_checkerboard(5, 8), beside=things(Checkerboard("again", 5, 8, 0.03))[:1]
    ),
    "checkerboard_5x8_is_6x8": lambda: in_place_of(of_checkerboard(5, 8), 6, 8),
    "checkerboard_5x8_is_5x9": lambda: in_place_of(of_checkerboard(5, 8), 5, 9),
    "checkerboard_5x8_is_5x7": lambda: in_place_of(of_checkerboard(5, 8), 5, 7),
    "checkerboard_3x4_is_4x4": lambda: in_place_of(of_checkerboard(3, 4), 4, 4),
    "charuco": lambda: of_charuco(7, 5),
    "aprilgrid": lambda: of_aprilgrid(6, 6),
    "tag": of_tag,
    "tag_grid": lambda: of_tag_grid(5, 7),
    "bundle": of_flat_bundle,
    "circles": lambda: of_circles(9, 7),
    "circles_larger_dot": lambda: of_circles(10, 10, larger_dot=True),
    "circles_light": lambda: of_circles(9, 7, light=True),
    "circles_asymmetric": lambda: of_circles(4, 11, asymmetric=True),
    "circles_asymmetric_light": lambda: of_circles(5, 8, asymmetric=True, light=True),
}


def pictured(kind: Kind, rng: np.random.Generator) -> tuple[Gray, scenes.Pose, bool]:
    """An image, its truth, and whether something covers a part of the target."""
    outline = kind.outline()
    most_px = 0.9 * scenes.HEIGHT * kind.element_m / (2.0 * max(kind.half_m))
    sides_px = (0.9 * kind.least_px, max(min(5.0 * kind.least_px, most_px), 1.5 * kind.least_px))
    camera = scenes.random_camera(rng)
    pose = scenes.random_pose(rng, camera, outline, kind.element_m, sides_px)
    light = scenes.random_light(rng)
    image = BACKGROUNDS[int(rng.integers(len(BACKGROUNDS)))](rng)
    margin = rng.uniform(*kind.margins) * (rng.random() < 0.8 or kind.margins[0] > 0.0)
    for _ in range(int(rng.integers(1, 3)) if kind.beside else 0):
        thing = kind.beside[int(rng.integers(len(kind.beside)))]
        other = scenes.random_pose(rng, camera, outline_of(thing.half_m), thing.unit_m, (0.5 * kind.least_px, 40.0))
        of_thing = per_unit(thing.unit_m, other, outline_of(thing.half_m))
        scenes.laid_over(image, other, thing.draw(of_thing, 1.0), light)
    what = kind.drawn or kind.target
    scenes.laid_over(image, pose, kind.draw(what, per_unit(kind.unit_m, pose, outline), margin), light)
    hull = scenes.projected(pose.camera, outline, pose.T)
    covered = False
    if rng.random() < COVERED:
        hidden = scenes.cover(rng, image, hull)
        inside = np.zeros(image.shape, np.uint8)
        cv2.fillPoly(inside, [np.rint(np.clip(hull, -1e4, 1e4)).astype(np.int32)], 1)
        covered = bool(hidden[inside > 0].sum() > LEAST_COVERED * max(int(inside.sum()), 1))
    if rng.random() < SHADED:
        image *= scenes.shade(rng, hull)
    return scenes.seen_by_camera(rng, image, light), pose, covered


def per_unit(unit_m: float, pose: scenes.Pose, outline: Array) -> int:
    """Pixels of a picture in a unit."""
    return int(np.clip(unit_m / scenes.pixel_m(pose, outline), 2, 64))


def run_image(kind: Kind, name: str, seed: int, number: int, keep: Path | None = None) -> Outcome:
    """Render, detect, compare."""
    rng = np.random.default_rng([seed, zlib.crc32(name.encode()), number])
    gray, pose, covered = pictured(kind, rng)
    elements = scenes.projected(pose.camera, kind.elements(), pose.T)
    side_px = min(float(np.linalg.norm(np.diff(elements, axis=axis), axis=-1).min()) for axis in (0, 1))
    start = time.perf_counter()
    (found,) = Detector(pose.camera, [kind.target])([gray])
    middle = time.perf_counter()
    kind.peer(gray)
    times = {"ours_s": middle - start, "peer_s": time.perf_counter() - middle}
    about = {"whole": scenes.is_whole(pose, kind.outline()), "covered": covered, "side_px": side_px}
    outcome = Outcome(number, refused="nothing found", **about, **times)
    used = [one for one in found.detections if one.rejection is None]
    if used:
        wrong = len(used) > 1
        errors, ways = min((_errors(kind, pose, used[0], way) for way in range(kind.ways)), key=_largest)
        wrong |= _largest((errors, ways)) > WRONG_PX or kind.drawn is not None
        sums = np.zeros(len(DIRECTIONS)) if wrong else _along(kind, pose, errors, ways)
        squares = 0.0 if wrong else float((errors**2).sum())
        outcome = Outcome(number, wrong=wrong, corners=len(errors), sums=sums, squares=squares, **about, **times)
    elif found.detections:
        outcome = Outcome(number, refused=str(found.detections[0].rejection), **about, **times)
    missed = kind.drawn is None and outcome.whole and not covered and side_px >= kind.least_px and not outcome.is_read
    if keep is not None and (outcome.wrong or missed):
        _keep(keep / f"{name}_{seed}_{number}_{'wrong' if outcome.wrong else 'missed'}.png", gray, kind, pose, used)
    return outcome


def _errors(kind: Kind, pose: scenes.Pose, detection: Detection, way: int) -> tuple[Array, Array]:
    """Errors (n, 2) of the corners, pixels, and where (n, 3) they are on the target if it is turned `way` times."""
    angle = 2.0 * np.pi * way / kind.ways
    turn = np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1.0]])
    at = kind.target.corners()[detection.indices] @ turn.T
    return detection.corners_px - scenes.projected(pose.camera, at, pose.T), at


def _largest(pair: tuple[Array, Array]) -> float:
    return float(np.linalg.norm(pair[0], axis=1).max())


def _along(kind: Kind, pose: scenes.Pose, errors: Array, at: Array) -> Array:
    """Sums of errors (n, 2) at places (n, 3) along `DIRECTIONS`."""
    nudge = 1e-3 * kind.element_m
    here = scenes.projected(pose.camera, at, pose.T)
    outwards = at / np.maximum(np.linalg.norm(at, axis=1, keepdims=True), 1e-9)
    uphill = pose.T[2, :3] * [1.0, 1.0, 0.0]  # on the target, along which the depth grows
    uphill = uphill / max(float(np.linalg.norm(uphill)), 1e-9)
    sums = [*errors.sum(axis=0)]
    for step in (np.array([1.0, 0, 0]), np.array([0, 1.0, 0]), outwards, uphill):
        along = scenes.projected(pose.camera, at + nudge * step, pose.T) - here
        along /= np.maximum(np.linalg.norm(along, axis=1, keepdims=True), 1e-12)
        sums.append(float((errors * along).sum()))
    return np.array(sums)


def _keep(path: Path, gray: Gray, kind: Kind, pose: scenes.Pose, used: list[Detection]) -> None:
    """The image beside itself with the truth (green) and what was found (red)."""
    marked = cv2.cvtColor(gray, cv2.COLOR_GRAY2BGR)
    for points, colour in (
        (scenes.projected(pose.camera, kind.target.corners(), pose.T), (0, 255, 0)),
        (np.concatenate([np.zeros((0, 2)), *(one.corners_px for one in used)]), (0, 0, 255)),
    ):
        for point in np.rint(points).astype(int):
            cv2.drawMarker(marked, point.tolist(), colour, cv2.MARKER_CROSS, 7)
    path.parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(path), np.hstack([cv2.cvtColor(gray, cv2.COLOR_GRAY2BGR), marked]))


def run_chunk(name: str, seed: int, numbers: range, keep: Path | None) -> list[Outcome]:
    """Some images of a kind, on one thread."""
    cv2.setNumThreads(1)
    kind = KINDS[name]()
    return [run_image(kind, name, seed, number, keep) for number in numbers]


def outcomes(name: str, images: int, seed: int, jobs: int = 1, keep: Path | None = None) -> list[Outcome]:
    """All images of a kind; the same whatever the number of processes."""
    chunks = [range(first, min(first + CHUNK, images)) for first in range(0, images, CHUNK)]
    if jobs == 1:
        return [one for chunk in chunks for one in run_chunk(name, seed, chunk, keep)]
    one_thread = dict.fromkeys(("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS"), "1")
    with ProcessPoolExecutor(jobs, env=one_thread) as pool:
        futures = [pool.submit(run_chunk, name, seed, chunk, keep) for chunk in chunks]
        return [one for future in futures for one in future.result()]


def rows(found: list[Outcome], kind: Kind) -> list[Row]:
    """The table of a kind against the bars."""
    large = [one for one in found if one.whole and not one.covered and one.side_px >= kind.least_px]
    covered = [one for one in found if one.covered]
    others = [one for one in found if not one.covered and one not in large]
    right = [one for one in found if one.is_read and not one.wrong]
    recall = Share.of([one.is_read and not one.wrong for one in large])
    reasons = Counter(one.refused for one in large if one.refused is not None).most_common(4)
    wrong = [one.number for one in found if one.wrong]
    corners = max(sum(one.corners for one in right), 1)
    rms = float(np.sqrt(sum(one.squares for one in right) / (2 * corners)))
    bias = sum((one.sums for one in right), start=np.zeros(len(DIRECTIONS))) / corners
    ours, peer = (float(np.sum([getattr(one, of) for one in found])) for of in ("ours_s", "peer_s"))
    result = [
        Row(f"recall, whole and {kind.least_px:g} px or more", str(recall), ">= 98 %", recall.value >= 0.98)
        if kind.drawn is None
        else Row(f"read, where {kind.drawn.name} is drawn", str(Share.of([one.is_read for one in found]))),
        Row(" refused", ", ".join(f"{reason}: {n}" for reason, n in reasons) or "none"),
        Row("misread", f"{len(wrong)} of {len(found)} images {wrong[:8] or ''}", "0", not wrong),
        Row("corners used", f"{sum(o.corners for o in large if o.is_read) / max(recall.held, 1):.2f} an image"),
        Row("rms of corners along an axis", f"{rms:.4f} px", "<= 0.05 px", rms <= 0.05),
        Row("largest bias", f"{np.abs(bias).max():.4f} px", "<= 0.01 px", bool(np.abs(bias).max() <= 0.01)),
        *(Row(f" {name}", f"{value:+.4f} px") for name, value in zip(DIRECTIONS, bias, strict=True)),
    ]
    for words, of in (("covered", covered), ("cut or small", others)):
        count = sum(one.wrong for one in of)
        refused = Share.of([not one.is_read for one in of])
        result += [Row(f"{words}: misread", f"{count} of {len(of)}", "0", count == 0), Row(" refused", str(refused))]
    each = f"{1e3 * ours / len(found):.1f} ms over {1e3 * peer / len(found):.1f} ms"
    return [*result, Row("time over OpenCV's own", f"{ours / max(peer, 1e-9):.2f}x ({each})")]


def main() -> int:
    """Run it; 0 if the bars are met."""
    parser = benchmark_parser(__doc__)
    parser.add_argument("--kinds", default=",".join(KINDS), help="names or their beginnings, with commas")
    parser.add_argument("--images", type=int, default=2000, help="of each kind (default: 2000)")
    parser.add_argument("--jobs", type=int, default=os.cpu_count(), help="processes (default: one for each core)")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--keep", type=Path, help="a folder for images that are misread or missed")
    arguments = parser.parse_args()
    given = arguments.kinds.split(",")
    begins = tuple(one for one in given if one not in KINDS)
    wanted = [name for name in KINDS if name in given or name.startswith(begins)]
    if not wanted:
        parser.error(f"no kind begins with {arguments.kinds!r}; there are {', '.join(KINDS)}")
    status = 0
    for name in wanted:
        found = outcomes(name, arguments.images, arguments.seed, arguments.jobs, arguments.keep)
        title = f"{name}, {arguments.images} rendered images, seed {arguments.seed}"
        status |= print_rows(title, rows(found, KINDS[name]()), store=arguments.store)
    return status


if __name__ == "__main__":
    raise SystemExit(main())
