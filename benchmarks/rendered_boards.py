"""Rendered images of each kind of target: how many are read, whether any is read wrong, how sharp the corners are.

    python benchmarks/rendered_boards.py [--kinds checkerboard_3x4,circles] [--images 2000] [--jobs 2] [--seed 1]

Each image has a camera with distortion, a target at some distance, tilted by up to 70 degrees and turned, on something
textured, with shade over a part of it, blur to 1.5 pixels, motion, vignetting, gamma, and noise to 4 of 255; in a share
of them something covers a part of it. An image depends on the kind, the seed and its number alone. A target counts as
read where the detector uses it, and as misread where any of its corners is more than a pixel from the truth, in every
order that its symmetry allows. Recall is of the targets that are whole and large enough. ``--keep FOLDER`` writes what
was misread or missed. A kind is a `Kind`: add yours to `rendered_kinds.KINDS`.
"""

from __future__ import annotations

import os
import time
import zlib
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np
import rendered_scenes as scenes
from bars import Row, Share, benchmark_parser, print_rows
from loky import ProcessPoolExecutor
from rendered_kinds import KINDS, Kind, outline_of
from rendered_prints import Array
from rendered_scenes import BACKGROUNDS, Gray

from gtsam_rwhec.detect.detector import Detection, Detector

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
    tilt_deg: float = 0.0
    blur_px: float = 0.0
    ours_s: float = 0.0
    peer_s: float = 0.0

    @property
    def is_read(self) -> bool:
        """Whether the detector uses the target."""
        return self.refused is None


def pictured(kind: Kind, rng: np.random.Generator) -> tuple[Gray, scenes.Pose, scenes.Light, bool]:
    """An image, its truth, its light, and whether something covers a part of the target."""
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
    return scenes.seen_by_camera(rng, image, light), pose, light, covered


def per_unit(unit_m: float, pose: scenes.Pose, outline: Array) -> int:
    """Pixels of a picture in a unit."""
    return int(np.clip(unit_m / scenes.pixel_m(pose, outline), 2, 64))


def run_image(kind: Kind, name: str, seed: int, number: int, keep: Path | None = None) -> Outcome:
    """Render, detect, compare."""
    rng = np.random.default_rng([seed, zlib.crc32(name.encode()), number])
    gray, pose, light, covered = pictured(kind, rng)
    elements = scenes.projected(pose.camera, kind.elements(), pose.T)
    side_px = min(float(np.linalg.norm(np.diff(elements, axis=axis), axis=-1).min()) for axis in (0, 1))
    start = time.perf_counter()
    (found,) = Detector(pose.camera, [kind.target])([gray])
    middle = time.perf_counter()
    kind.peer(gray)
    times = {"ours_s": middle - start, "peer_s": time.perf_counter() - middle}
    about = {"whole": scenes.is_whole(pose, kind.outline()), "covered": covered, "side_px": side_px}
    about |= {"tilt_deg": pose.tilt_deg, "blur_px": light.blur_px}
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
    bias = _bias(right)
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
    for what, word in (("side_px", "larger"), ("tilt_deg", "more tilted"), ("blur_px", "more blurred")):
        order = sorted(right, key=lambda one: float(getattr(one, what)))
        halves = [float(np.abs(_bias(half)).max()) for half in (order[: len(order) // 2], order[len(order) // 2 :])]
        words = f"{halves[0]:.4f}, {halves[1]:.4f} px"
        result.append(Row(f" largest of the half that is less, and of that which is {word}", words))
    for words, of in (("covered", covered), ("cut or small", others)):
        count = sum(one.wrong for one in of)
        refused = Share.of([not one.is_read for one in of])
        result += [Row(f"{words}: misread", f"{count} of {len(of)}", "0", count == 0), Row(" refused", str(refused))]
    each = f"{1e3 * ours / len(found):.1f} ms over {1e3 * peer / len(found):.1f} ms"
    return [*result, Row("time over OpenCV's own", f"{ours / max(peer, 1e-9):.2f}x ({each})")]


def _bias(right: list[Outcome]) -> Array:
    """The mean error along `DIRECTIONS` of images that were read right."""
    sums = sum((one.sums for one in right), start=np.zeros(len(DIRECTIONS)))
    return np.asarray(sums / max(sum(one.corners for one in right), 1))


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
        status |= print_rows(title, rows(found, KINDS[name]()))
    return status


if __name__ == "__main__":
    raise SystemExit(main())
