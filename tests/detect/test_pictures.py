"""Pictures of detections and contact sheets: what is marked, told without colour; text of any script."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from rendered import PINHOLE
from rwhec_factors import se3

from gtsam_rwhec.detect.contact_sheet import (
    ACROSS,
    DETAIL,
    GAP,
    HEADER,
    WIDTH,
    Band,
    Outcome,
    Outline,
    Tile,
    contact_sheet,
    detail_of,
)
from gtsam_rwhec.detect.pictures import (
    LONGEST_PX,
    NOT_USED,
    SIDE_PX,
    USED,
    Picture,
    Words,
    draw,
    draw_errors,
    fitted,
    jpeg_of,
    magnification,
    width_of,
    wrapped,
    written,
)
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.logs import DetectionRecord

CORNERS = np.stack(np.meshgrid(np.arange(4) * 30.0 + 100.25, np.arange(3) * 30.0 + 90.5), axis=-1).reshape(-1, 2)
GRAY = np.full((240, 320), 128, dtype=np.uint8)


def record(corners: Array = CORNERS, reason: str = "", T: Array | None = None) -> DetectionRecord:
    return DetectionRecord(1, 1, "/d", "camera", "checkerboard", "board", corners, T, reason=reason)


def is_drawn(picture: Picture, colour: tuple[int, int, int]) -> np.ndarray:
    return np.asarray((np.abs(picture.astype(int) - colour) < 60).all(axis=2))


def test_every_corner_has_its_cross_at_its_place() -> None:
    picture = draw(GRAY, [record()], PINHOLE)
    assert picture.shape == (480, 640, 3)  # a small image is drawn twice as large
    places = 2.0 * (CORNERS + 0.5) - 0.5
    changed = (picture != 128).any(axis=2)
    rows, columns = np.indices(changed.shape)
    for u, v in places[1:]:  # the crosses' middles of mass are where the corners are, but for the line of the order
        near = (np.abs(columns - u) < 4.5) & (np.abs(rows - v) < 4.5) & changed
        assert near.sum() > 10
        assert abs(columns[near].mean() - u) < 0.7
        assert abs(rows[near].mean() - v) < 0.7


def test_the_first_corner_is_ringed() -> None:
    drawn = is_drawn(draw(GRAY, [record()], PINHOLE), USED)
    turned = is_drawn(draw(GRAY, [record(CORNERS[::-1].copy())], PINHOLE), USED)
    first, last = (2.0 * (corner + 0.5) - 0.5 for corner in (CORNERS[0], CORNERS[-1]))

    def around(picture: np.ndarray, place: Array) -> int:
        u, v = np.rint(place).astype(int)
        return int(picture[v - 14 : v + 15, u - 14 : u + 15].sum())

    assert around(drawn, first) > around(drawn, last) + 20
    assert around(turned, last) > around(turned, first) + 20


def test_rejected_ones_have_another_form_too() -> None:
    used, rejected = draw(GRAY, [record()], PINHOLE), draw(GRAY, [record(reason="small")], PINHOLE)
    assert is_drawn(used, USED).sum() > 200
    assert not is_drawn(used, NOT_USED).any()
    assert is_drawn(rejected, NOT_USED).sum() > 200
    assert not is_drawn(rejected, USED).any()
    # Without colour: an upright cross has its arms beside the corner, an oblique one between.
    u, v = np.rint(2.0 * (CORNERS[6] + 0.5) - 0.5).astype(int)
    changed = [(picture[v - 5 : v + 6, u - 5 : u + 6] != 128).any(axis=2) for picture in (used, rejected)]
    assert changed[0][5, 1]
    assert changed[1][2, 2]
    assert not changed[0][1, 1]


def test_reasons_axes_and_captions_are_written() -> None:
    T = se3.pose(np.eye(3), (0.0, 0.0, 0.5))
    plain, posed = draw(GRAY, [record()], PINHOLE), draw(GRAY, [record(T=T)], PINHOLE)
    assert (posed != plain).any()
    assert (draw(GRAY, [record(reason="small")], PINHOLE) != draw(GRAY, [record(reason="grazing")], PINHOLE)).any()
    nothing = draw(GRAY, [], PINHOLE, "camera, 0001.png: nothing seen")
    assert nothing.shape[0] > 480
    assert (nothing[:480] == 128).all()
    assert (nothing[480:] < 100).any()


def test_what_strangers_logs_may_hold() -> None:
    for corners in (np.full((4, 2), np.nan), np.full((4, 2), 1e30), np.zeros((0, 2)), np.array([[5.0, 5.0]])):
        assert draw(GRAY, [record(corners, "no pose")], PINHOLE).shape == (480, 640, 3)


WIDE = np.full((480, 640), 128, dtype=np.uint8)
SEEN = np.array([[300.0, 200.0], [380.0, 200.0], [300.0, 260.0], [380.0, 260.0]])


def is_coloured(picture: np.ndarray) -> np.ndarray:
    """Pixels (x, y) that are neither gray nor white."""
    spread = picture.astype(int).max(axis=2) - picture.astype(int).min(axis=2)
    return np.argwhere(spread > 60)[:, ::-1]


def test_only_the_target_is_shown_and_each_corner_has_a_mark() -> None:
    drawn = draw_errors(WIDE, SEEN, np.zeros((4, 2)))
    assert max(drawn.picture.shape) == SIDE_PX
    assert drawn.magnified == 1.0
    marks = is_coloured(drawn.picture)
    _, _, _, centres = cv2.connectedComponentsWithStats(
        cv2.dilate(
            np.bincount(marks[:, 1] * SIDE_PX + marks[:, 0], minlength=drawn.picture.shape[0] * SIDE_PX)
            .reshape(-1, SIDE_PX)
            .astype(np.uint8),
            np.ones((9, 9)),
        )
    )
    width, height = np.ptp(centres[1:], axis=0)
    assert len(centres) == 1 + len(SEEN)
    assert width / height == pytest.approx(80.0 / 60.0, rel=0.02)


def test_errors_are_as_long_as_is_said() -> None:
    errors = np.zeros((4, 2))
    errors[0] = [-0.11, 0.0]  # the answer has it to the right
    drawn, none = draw_errors(WIDE, SEEN, errors), draw_errors(WIDE, SEEN, np.zeros((4, 2)))
    changed = np.argwhere((drawn.picture != none.picture).any(axis=2))[:, ::-1]
    scale = SIDE_PX / 144.0  # the window's width: 80 + 2 (0.25 80 + 4), or of its height, 60 + 2 (0.25 80 + 4), 4 / 3
    assert drawn.magnified in (20.0, 50.0, 100.0)
    assert np.ptp(changed[:, 0]) == pytest.approx(scale * drawn.magnified * 0.11, abs=14.0)


@pytest.mark.parametrize(("longest", "times"), [(0.0, 1.0), (0.1, 500.0), (1.0, 50.0), (0.011, 1000.0), (400.0, 1.0)])
def test_errors_are_magnified_by_round_numbers(longest: float, times: float) -> None:
    assert magnification(np.array([[longest, 0.0]]), 1.0) == times
    assert longest * times <= max(LONGEST_PX, longest)


def test_corners_at_the_edge_and_errors_that_are_not_known() -> None:
    errors = np.array([[np.nan, np.nan], [900.0, 0.0]])
    drawn = draw_errors(WIDE, np.array([[-2.0, -1.0], [639.0, 479.0]]), errors)
    assert drawn.picture.ndim == 3


def test_a_jpeg_is_not_larger_than_it_may_be() -> None:
    noisy = np.random.default_rng(0).integers(0, 255, (400, 500, 3), dtype=np.uint8)
    content = jpeg_of(noisy, 20_000)
    assert len(content) <= 20_000
    read = cv2.imdecode(np.frombuffer(content, dtype=np.uint8), cv2.IMREAD_COLOR)
    assert read is not None
    assert read.shape[1] / read.shape[0] == pytest.approx(1.25, rel=0.05)
    assert cv2.imdecode(np.frombuffer(jpeg_of(WIDE, 20_000), dtype=np.uint8), cv2.IMREAD_COLOR).shape[:2] == WIDE.shape


THUMBNAIL = np.full((130, WIDTH), 90, dtype=np.uint8)
BOARD = np.array([[0.2, 0.1], [0.5, 0.1], [0.5, 0.3], [0.2, 0.3]])


def tile(outcome: Outcome, words: str = "", name: str = "0001.png") -> Tile:
    outlines = (Outline(BOARD, outcome is Outcome.FOUND),) if outcome in (Outcome.FOUND, Outcome.REJECTED) else ()
    return Tile(outcome, name, words, None if outcome is Outcome.FAILED else THUMBNAIL, outlines)


def test_every_outcome_is_told_without_colour() -> None:
    sheets = [contact_sheet([Band("camera", "1 image", (tile(outcome),))]) for outcome in Outcome]
    grays = [np.asarray(cv2.cvtColor(sheet, cv2.COLOR_BGR2GRAY)) for sheet in sheets]
    height = min(len(gray) for gray in grays)
    grays = [gray[:height] for gray in grays]
    assert len({outcome.mark for outcome in Outcome}) == len(Outcome)
    for i, one in enumerate(grays):
        for other in grays[:i]:  # the frame, the picture and the words differ in lightness or in form
            different = np.abs(one.astype(int) - other) > 60
            assert different[HEADER + 150 :].sum() > 40
            assert different[: HEADER + 150].sum() > 100


def test_a_small_target_is_shown_larger_with_its_corners() -> None:
    gray = np.full((520, 4 * WIDTH), 90, dtype=np.uint8)
    gray[100:140, 200:260] = 250  # the target, 60 x 40 pixels
    corners = np.array([[199.5, 99.5], [259.5, 99.5], [259.5, 139.5], [199.5, 139.5]])
    outline = Outline((corners + 0.5) / gray.shape[1], is_used=True)
    detail = detail_of(gray, outline)
    assert detail is not None
    assert detail.gray.shape == (DETAIL, DETAIL)
    rows, columns = np.nonzero(detail.gray > 170)
    np.testing.assert_allclose(
        [columns.min() - 0.5, rows.min() - 0.5, columns.max() + 0.5, rows.max() + 0.5],
        [*detail.corners[0], *detail.corners[2]],
        atol=0.8,
    )
    assert detail_of(gray, Outline(3.5 * outline.corners, is_used=True)) is not None
    assert detail_of(gray, Outline(np.array([[0.1, 0.1], [0.6, 0.1], [0.6, 0.5], [0.1, 0.5]]), is_used=True)) is None
    assert detail_of(gray, Outline(np.full((4, 2), np.nan), is_used=True)) is None
    edge = detail_of(gray, Outline(np.array([[0.0, 0.0], [0.05, 0.0], [0.05, 0.05]]), is_used=True))
    assert edge is not None
    plain, large = (Tile(Outcome.FOUND, "1.png", "", THUMBNAIL, (outline,), one) for one in (None, detail))
    assert (contact_sheet([Band("a", "", (plain,))]) != contact_sheet([Band("a", "", (large,))])).any()


def test_a_band_for_each_sensor() -> None:
    bands = [
        Band(f"camera{i}", "many", tuple(tile(Outcome.NOTHING) for _ in range(count))) for i, count in ((1, 7), (2, 1))
    ]
    sheet = contact_sheet(bands)
    assert sheet.shape[1] == GAP + ACROSS * (WIDTH + GAP)
    heights = [contact_sheet([band]).shape[0] for band in bands]
    assert sheet.shape[0] == sum(heights)
    assert heights[0] > 1.7 * heights[1]  # seven are two rows
    assert contact_sheet([]).size > 0


def test_tall_and_broken_pictures() -> None:
    tall = Tile(
        Outcome.FOUND, "tall.png", "", np.zeros((5 * WIDTH, WIDTH), np.uint8), (Outline(np.full((4, 2), np.nan), True),)
    )
    sheet = contact_sheet([Band("camera", "2 images", (tall, tile(Outcome.FAILED, "cut short")))])
    assert sheet.shape[0] < 2.2 * WIDTH


@pytest.mark.parametrize("text", ["ascii", "Kamera_größe_0001.png", "камера", "x" * 300, "evil\x1b[2J\n"])
def test_text_of_any_script_fits(text: str) -> None:
    assert width_of(fitted(text, 12, 100), 12) <= 100
    assert all(width_of(line, 12) <= 100 for line in wrapped(f"{text} {text} and more", 12, 100, 2))
    white = np.full((40, 400, 3), 255, dtype=np.uint8)
    picture = written(white, [Words((5, 5), text, 16, (0, 0, 0))])
    assert (picture < 100).any()
    assert (white == 255).all()


def test_the_end_of_a_name_is_kept() -> None:
    assert fitted("image_with_a_very_long_name_0001.png", 12, 120).endswith(".png")
    assert wrapped("one two three four five six", 12, 50, 2)[-1].endswith("…")
    assert wrapped("short", 12, 100, 2) == ["short"]
