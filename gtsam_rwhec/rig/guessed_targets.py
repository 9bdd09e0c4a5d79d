"""Guesses of the targets from the tags that were seen: single tags and boards. Their sizes are guesses too."""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import cv2
import numpy as np

from gtsam_rwhec.cameras.targets import FAMILIES, Checkerboard, family_named
from gtsam_rwhec.detect.tags import SeenTag
from gtsam_rwhec.files.terminal_text import rounded, some
from gtsam_rwhec.files.yaml_lines import KeyPath
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.rig.guessed_boards import BoardSeen
from gtsam_rwhec.rig.log_contents import DriverTopic, ImageTopic, free_name
from gtsam_rwhec.rig.target_sections import (
    AprilGridTarget,
    CharucoTarget,
    CheckerboardTarget,
    CircleGridTarget,
    PrintedTarget,
    TagGridTarget,
    TagTarget,
)

#: Metres. A tag's side has this value in a first rig file, until a person measures it.
TAG_M = 0.1
#: Metres. The side of a ChArUco board's square has this value, until a person measures it.
SQUARE_M = 0.04
#: Metres. The side of a ChArUco board's marker has this value, until a person measures it.
MARKER_M = 0.03
#: An AprilGrid's gap between tags, divided by a tag's side, has this value, until a person measures it.
SPACING = 0.3
#: At least this number of markers with consecutive ids is taken for a ChArUco board.
BOARD = 6
#: At least this number of tags with a double border is taken for an AprilGrid.
GRID = 4
#: A size that is a guess gets this remark.
TODO = "TODO measure"
#: A size that a driver states gets this remark.
OF_DRIVER = "as its driver says"


@dataclass(frozen=True)
class Guess:
    """A guess of a target: its name, its section, and the comment beside it."""

    name: str
    section: PrintedTarget
    remark: str


def targets_seen(images: Sequence[ImageTopic], drivers: Iterable[DriverTopic]) -> tuple[list[Guess], list[str]]:
    """Guesses of the targets, and remarks on tags that were left out."""
    looked_at = sum(topic.looked_at for topic in images)
    guesses, remarks = [], []
    for family in dict.fromkeys(family for topic in images for family in topic.tags):
        single, double = Counter[int](), Counter[int]()
        views = [[tag for tag in tags if tag.family == family] for topic in images for tags in topic.seen]
        for topic in images:
            single.update(topic.tags[family].single if family in topic.tags else {})
            double.update(topic.tags[family].double if family in topic.tags else {})
        # A tag that was seen with both borders has the border with which it was seen more often.
        grid = sorted(i for i in double if double[i] > single[i])
        if len(grid) >= GRID:
            guesses.append(_aprilgrid(family, grid, views))
        ids = {i: single[i] for i in sorted(single) if i not in grid}
        sure = {i: count for i, count in ids.items() if count >= least_sightings(family, looked_at)}
        doubtful = [i for i in ids if i not in sure]
        if doubtful:
            remarks.append(f"left out, seen too seldom to be sure: {family} {_listed(doubtful)}")
        guesses += _of_family(_smallest(family, sure), sure, looked_at, views)
    guesses += _of_drivers(drivers, guesses)
    return guesses, remarks


def first_targets(
    images: Sequence[ImageTopic], drivers: Iterable[DriverTopic], taken: set[str]
) -> tuple[dict[str, PrintedTarget], dict[KeyPath, str], list[str]]:
    """Guesses of all targets by free names, the comments beside them, and notes; an example if nothing was seen."""
    guesses, notes = targets_seen(images, drivers)
    guesses += boards_guessed(images)
    if guesses:
        names = ", ".join(guess.name for guess in guesses)
        notes.append(f"targets seen: {names} (their sizes in the rig file are guesses: measure them)")
    else:
        notes.append(
            f"no target in {sum(topic.looked_at for topic in images)} images that were searched: no tags of any "
            "family, no checkerboard and no grid of circles, and none from drivers. Write the targets into the rig file"
        )
        nothing = TagTarget(type="tag", family="tag36h11", id=0, size_m=TAG_M)
        guesses = [Guess("tag_0", nothing, "TODO an example: no targets were seen")]
    named = {free_name(guess.name, taken): guess for guess in guesses}
    remarks: dict[KeyPath, str] = {("targets", name): guess.remark for name, guess in named.items()}
    return {name: guess.section for name, guess in named.items()}, remarks, notes


def take_sizes(targets: dict[str, PrintedTarget], remarks: dict[KeyPath, str], sizes: Mapping[str, float]) -> None:
    """Multiply lengths that nobody stated by what the motion says: true over guessed length, by target."""
    for name, factor in sizes.items():
        if TODO in remarks["targets", name] and OF_DRIVER not in remarks["targets", name]:
            targets[name] = with_size(targets[name], factor)
            remarks["targets", name] += "; the length here is what the motion says"


def boards_guessed(images: Iterable[ImageTopic]) -> list[Guess]:
    """Guesses of boards without tags, of those that were seen by each camera."""
    most: dict[tuple[str, tuple[int, int]], list[tuple[ImageTopic, BoardSeen]]] = {}
    for topic in images:
        for seen in topic.boards:
            if _has_markers(seen, topic.seen):
                continue  # a ChArUco board, which the tags propose
            most.setdefault((seen.board.family, seen.counts), []).append((topic, seen))
    guesses: dict[str, tuple[int, Guess]] = {}
    for (family, (across, down)), views in most.items():
        number = sum(len(seen.images) for _, seen in views)
        of = sum(topic.looked_at for topic, _ in views)
        passed = f"{across} x {down} passed every test in {number} of {of} images"
        board = views[0][1].board
        if isinstance(board, Checkerboard):
            section: PrintedTarget = CheckerboardTarget(
                type="checkerboard", inner_corners=(across, down), square_m=SQUARE_M
            )
            name, remark = "board", f"{TODO} a square; {passed} (inner corners, not squares)"
        else:
            section = CircleGridTarget(
                type="circle_grid",
                circles=(across, down),
                spacing_m=SQUARE_M,
                larger_dot=bool(board.larger_dot),
                asymmetric=board.asymmetric,
            )
            dot = ", with one larger dot: at the lower left as printed, or name its corner" if board.larger_dot else ""
            what = "from one row to the next" if board.asymmetric else "between centres of neighbours"
            name, remark = "grid", f"{TODO} {what}; {passed}{dot}"
        if number > guesses.get(family, (0, None))[0]:
            guesses[family] = number, Guess(name, section, remark)
    return [guess for _, guess in guesses.values()]


def _has_markers(board: BoardSeen, tags: Sequence[Sequence[SeenTag]]) -> bool:
    """Whether tags are between a checkerboard's corners, in most images in which it was found: it is a ChArUco board.

    ``tags`` are those of each image that was searched.
    """
    if not isinstance(board.board, Checkerboard):
        return False
    inside = 0
    for image, corners in zip(board.images, board.corners_px, strict=True):
        hull = cv2.convexHull(np.asarray(corners, dtype=np.float32))
        middles = (tuple(map(float, tag.middle_px)) for tag in tags[image])
        inside += sum(cv2.pointPolygonTest(hull, middle, False) > 0.0 for middle in middles) > 1
    return 2 * inside > len(board.images)


def with_size(section: PrintedTarget, factor: float) -> PrintedTarget:
    """The section with its lengths multiplied by this factor, to four digits."""
    lengths = {
        name: float(f"{getattr(section, name) * factor:.4g}")
        for name in type(section).model_fields
        if name.endswith("_m")
    }
    return section.model_copy(update=lengths)


def least_sightings(family: str, looked_at: int) -> int:
    """The number of images that must show a tag. Families of few bits need more: false detections are frequent."""
    if looked_at < 3 or family == "tag36h11":
        return 1
    return 3 if family in ("tag16h5", "aruco_4x4_1000", "aruco_original") else 2


def _smallest(family: str, ids: Collection[int]) -> str:
    """The smallest of ArUco's dictionaries of this kind that has the ids: it gives the fewest false detections."""
    stem = re.fullmatch(r"(aruco_\dx\d)_1000", family)
    if stem is None or not ids:
        return family
    sizes = (50, 100, 250, 1000)
    return next(f"{stem[1]}_{size}" for size in sizes if FAMILIES[f"{stem[1]}_{size}"] > max(ids))


def _of_family(family: str, ids: dict[int, int], looked_at: int, views: Sequence[Sequence[SeenTag]]) -> Iterator[Guess]:
    """A board if many tags have consecutive ids and lie as on a board, or are ArUco markers; otherwise single tags."""
    order = sorted(ids)
    is_aruco = family.startswith("aruco")
    if len(ids) >= BOARD and order[-1] - order[0] < 1.5 * len(ids):
        layout = layout_of(("charuco", "tag_grid") if is_aruco else ("tag_grid",), order, views)
        if layout is None and is_aruco:
            layout = Layout("charuco", *_squares(order[-1] - order[0] + 1), MARKER_M / SQUARE_M)
        if layout is not None:
            yield _of_layout(family, order, layout)
            return
    for i in order:
        tag = TagTarget(type="tag", family=family, id=i, size_m=TAG_M)
        yield Guess(f"{family}_{i}", tag, f"{TODO}; seen in {ids[i]} of {looked_at} images")


def _of_layout(family: str, ids: list[int], layout: Layout) -> Guess:
    """A board with the columns and rows found in the images, or with guessed ones."""
    counts, gap, first = (layout.columns, layout.rows), 1.0 / layout.share - 1.0, ids[0]
    if layout.kind == "charuco":
        marker_m = float(f"{SQUARE_M * layout.share:.3g}")
        section: PrintedTarget = CharucoTarget(
            type="charuco", family=family, squares=counts, square_m=SQUARE_M, marker_m=marker_m, first_id=first
        )
        name, lengths = f"board_{family.removeprefix('aruco_')}", "a square and a marker"
    elif layout.kind == "aprilgrid":
        section = AprilGridTarget(
            type="aprilgrid", family=family, tags=counts, tag_m=TAG_M, spacing=round(gap, 3), first_id=first
        )
        name, lengths = f"grid_{family}", "a tag, and the gap over it (spacing)"
    else:
        section = TagGridTarget(
            type="tag_grid", family=family, tags=counts, tag_m=TAG_M, gap_m=float(f"{TAG_M * gap:.3g}"), first_id=first
        )
        name, lengths = f"grid_{family}", "a tag and the gap"
    if not layout.images:
        return Guess(name, section, f"TODO count them, measure {lengths}: a guess from the ids {_listed(ids)}")
    fits = f"the tags lie so in {layout.images} images, to {rounded(layout.off, 2)} of a tag's side"
    return Guess(name, section, f"{TODO} {lengths}; {fits}; other columns and rows do not fit")


def _aprilgrid(family: str, ids: list[int], views: Sequence[Sequence[SeenTag]]) -> Guess:
    layout = layout_of(("aprilgrid",), ids, views)
    if layout is None:
        count = ids[-1] - ids[0] + 1
        columns = math.ceil(math.sqrt(count))
        layout = Layout("aprilgrid", columns, math.ceil(count / columns), 1.0 / (1.0 + SPACING))
    return _of_layout(family, ids, layout)


def _of_drivers(drivers: Iterable[DriverTopic], already: Iterable[Guess]) -> Iterator[Guess]:
    """Tags that only a driver saw, with the driver's size if it states one."""
    have = {(g.section.family, g.section.id) for g in already if isinstance(g.section, TagTarget)}
    for driver in drivers:
        for family, ids in driver.ids.items():
            known = family_named(family)
            for i in sorted(ids):
                if (known, i) in have or (known is not None and i >= FAMILIES[known]):
                    continue
                have.add((known or "tag36h11", i))
                stated = driver.size_m.get((family, i))
                size_m = stated if stated is not None and 0.0 < stated < 10.0 else TAG_M
                remark = f"{TODO}; {OF_DRIVER if size_m == stated else 'a guess'}"
                if known is None:
                    remark += f"; TODO the family, which its driver calls {family!r}"
                section = TagTarget(type="tag", family=known or "tag36h11", id=i, size_m=size_m)
                yield Guess(f"{known or 'tag'}_{i}", section, f"{remark}; {ids[i]} detections")


def _squares(markers: int) -> tuple[int, int]:
    """Columns and rows of a board with this number of markers, as near to a square as possible."""
    boards = [(columns, rows) for columns in range(2, 101) for rows in range(2, columns + 1)]
    fitting = [(columns, rows) for columns, rows in boards if columns * rows // 2 == markers]
    return min(fitting, key=lambda board: board[0] - board[1], default=(7, 5))


def _listed(ids: list[int]) -> str:
    if len(ids) > 3 and ids[-1] - ids[0] == len(ids) - 1:
        return f"{ids[0]} to {ids[-1]}"
    return some([str(i) for i in ids], 10)


#: A ChArUco board is counted by squares, the others by tags.
Kind = Literal["charuco", "aprilgrid", "tag_grid"]
#: An image needs at least this number of the board's tags: a homography fits any four tag centres.
LEAST_TAGS = 6
#: A board needs at least this number of images.
LEAST_IMAGES = 2
#: The most that tag centres may be off, over a tag's side; other layouts must be worse by this factor.
MOST_OFF, WORSE = 0.12, 3.0
#: A board has at most this number of columns and of rows, and this ratio between the two.
MOST, LONGEST = 40, 5.0


@dataclass(frozen=True)
class Layout:
    """A board's layout."""

    kind: Kind
    #: columns, rows: as the rig file counts them: squares of a ChArUco board, else tags
    columns: int
    rows: int
    share: float  #: A tag's side over the step from one to the next; of a ChArUco board over a square's side
    #: Root mean square error of the tags' centres, over a tag's side; the median over images
    off: float = math.nan
    images: int = 0  #: The images that were compared; none if the layout is a guess


def layout_of(kinds: Iterable[Kind], ids: Sequence[int], views: Iterable[Sequence[SeenTag]]) -> Layout | None:
    """The layout of the tags with ids from ``ids[0]`` to ``ids[-1]``, in increasing order; None if the images do
    not determine it.

    `kinds` are the possible kinds of the board, and `views` the tags of its family in each image.
    """
    first, count = ids[0], ids[-1] - ids[0] + 1
    wanted = set(ids)
    seen = [[tag for tag in tags if tag.id in wanted] for tags in views]
    seen = [tags for tags in seen if len({tag.id for tag in tags}) == len(tags) >= LEAST_TAGS]
    if len(seen) < LEAST_IMAGES:
        return None
    tried = []
    for kind in kinds:
        for columns, rows in _sizes(kind, count):
            places = _places(kind, columns, rows)
            fits = [_fit(places[[tag.id - first for tag in tags]], tags) for tags in seen]
            off = float(np.median([fit[0] for fit in fits]))
            share = float(np.median([fit[1] for fit in fits]))
            tried.append(Layout(kind, columns, rows, share, off, len(seen)))
    tried.sort(key=lambda layout: layout.off)
    if not tried or tried[0].off > MOST_OFF or not 0.05 < tried[0].share < 1.0:
        return None
    # One more square without a marker does not move the markers: the smaller board is taken.
    best, *others = tried
    same = [other for other in others if other.kind == best.kind and abs(other.off - best.off) < 1e-9]
    if any(other.off < WORSE * best.off for other in others if other not in same):
        return None
    return min([best, *same], key=lambda layout: layout.columns * layout.rows)


def _sizes(kind: Kind, count: int) -> list[tuple[int, int]]:
    """Columns and rows of boards with this number of tags."""
    sizes = [(c, r) for c in range(2, MOST + 1) for r in range(2, MOST + 1) if max(c, r) <= LONGEST * min(c, r)]
    return [(c, r) for c, r in sizes if (c * r // 2 if kind == "charuco" else c * r) == count]


def _places(kind: Kind, columns: int, rows: int) -> Array:
    """The tags' centres (n, 2) in steps, x to the right and y up on the printed board."""
    cells = np.meshgrid(np.arange(columns), np.arange(rows))
    x, y = cells[0].ravel(), cells[1].ravel()
    if kind == "charuco":  # markers are in the white squares, and the upper left one is black
        white = (x + y) % 2 == 1
        x, y = x[white], y[white]
    return np.stack([x, y if kind == "aprilgrid" else -y], axis=1).astype(float)


def _fit(places: Array, tags: Sequence[SeenTag]) -> tuple[float, float]:
    """The error of the centres over a tag's side, and a tag's side in steps; infinite if the tags are rotated."""
    middles = np.array([tag.middle_px for tag in tags], dtype=float)
    sides = np.array([tag.side_px for tag in tags])
    H = cv2.findHomography(places, middles, 0)[0]
    if H is None or not np.isfinite(H).all() or abs(np.linalg.det(H)) < 1e-12:
        return np.inf, np.nan
    there = cv2.perspectiveTransform(places[:, None], H)[:, 0]
    off = float(np.sqrt((((there - middles) / sides[:, None]) ** 2).sum(axis=1).mean()))
    corners = np.array([tag.corners_px for tag in tags], dtype=float)
    flat = cv2.perspectiveTransform(corners.reshape(-1, 1, 2), np.linalg.inv(H)).reshape(-1, 4, 2)
    right, up = flat[:, 1] - flat[:, 0], flat[:, 0] - flat[:, 3]  # corners from the top left, clockwise
    upright = (right[:, 0] > np.abs(right[:, 1])) & (up[:, 1] > np.abs(up[:, 0]))
    if not upright.mean() > 0.8:
        return np.inf, np.nan
    return off, float(np.median(np.linalg.norm(np.concatenate([right, up]), axis=1)))
