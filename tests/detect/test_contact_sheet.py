"""Contact sheets: a band for each sensor, and what became of an image told without colour; text of any script."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

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
from gtsam_rwhec.detect.pictures import Words, fitted, width_of, wrapped, written

GRAY = np.full((130, WIDTH), 90, dtype=np.uint8)
BOARD = np.array([[0.2, 0.1], [0.5, 0.1], [0.5, 0.3], [0.2, 0.3]])


def tile(outcome: Outcome, words: str = "", name: str = "0001.png") -> Tile:
    outlines = (Outline(BOARD, outcome is Outcome.FOUND),) if outcome in (Outcome.FOUND, Outcome.REJECTED) else ()
    return Tile(outcome, name, words, None if outcome is Outcome.FAILED else GRAY, outlines)


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
    plain, large = (Tile(Outcome.FOUND, "1.png", "", GRAY, (outline,), one) for one in (None, detail))
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
