"""How unknowns are named."""

from __future__ import annotations

import pytest

from gtsam_rwhec.fitting.unknowns import Unknown, UnknownKind, slots_of


@pytest.mark.parametrize(
    ("name", "unknown"),
    [
        ("cam_0", Unknown(UnknownKind.FRAME, "cam_0")),
        ("scale", Unknown(UnknownKind.SCALE)),
        ("scale:tag_0", Unknown(UnknownKind.SCALE, "tag_0")),
        ("time_offset:cam:left", Unknown(UnknownKind.TIME_OFFSET, "cam:left")),
        ("frame:x", Unknown(UnknownKind.FRAME, "frame:x")),
        ("time_offset", Unknown(UnknownKind.FRAME, "time_offset")),
    ],
)
def test_a_name_is_read_and_written_the_same(name: str, unknown: Unknown) -> None:
    assert Unknown.of(name) == unknown
    assert str(unknown) == name
    assert Unknown.of(unknown) is unknown


def test_parameters_stand_one_after_the_other() -> None:
    cam, scale, tag = (Unknown.of(name) for name in ("cam", "scale", "tag"))
    assert slots_of((cam, scale, tag)) == {cam: slice(0, 6), scale: slice(6, 7), tag: slice(7, 13)}
