"""The drawings of frames that are committed are those that the script makes."""

from __future__ import annotations

from pathlib import Path
from xml.etree import ElementTree

import pytest
from places import REPOSITORY, script

drawings = script(REPOSITORY / "docs" / "building" / "frame_drawings.py")
PICTURES: Path = drawings.PICTURES


@pytest.mark.parametrize("name", drawings.drawings())
def test_a_committed_drawing_is_what_the_script_makes(name: str) -> None:
    text = drawings.drawings()[name]
    assert (PICTURES / name).read_text(encoding="utf-8") == text, "run python docs/building/frame_drawings.py"


@pytest.mark.parametrize("name", drawings.drawings())
def test_nothing_is_drawn_outside_of_the_picture(name: str) -> None:
    for box in ElementTree.fromstring(drawings.drawings()[name]).iter("{http://www.w3.org/2000/svg}rect"):
        left, top = float(box.get("x", 0)), float(box.get("y", 0))
        assert 0 <= left <= left + float(box.get("width", 0)) <= drawings.WIDTH
        assert 0 <= top <= top + float(box.get("height", 0)) <= drawings.HEIGHT
