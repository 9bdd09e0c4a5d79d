"""Pictures of detections: marks where corners are, the first one ringed, rejected ones told apart without colour."""

from __future__ import annotations

import numpy as np
from rendered import PINHOLE

from gtsam_rwhec.detect.pictures import NOT_USED, USED, Picture, draw
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
    T = np.eye(4)
    T[:3, 3] = (0.0, 0.0, 0.5)
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
