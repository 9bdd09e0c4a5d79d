"""Rig files."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from harness import Harness, scratch
from mutations import words_and_lines
from rig_texts import FULL, MINIMAL

from gtsam_rwhec.rig import rig_file

FOLDER = scratch()
CELL = Path(__file__).resolve().parents[2] / "data" / "cell"


def read(data: bytes) -> None:
    """A rig; what was read can be written, and reads back equal."""
    path = FOLDER / "rig.yaml"
    path.write_bytes(data)
    rig = rig_file.read_rig(path)
    again = rig_file.parse_rig(rig_file.rig_text(rig), str(path), FOLDER)
    assert again == rig, "what is written reads back as another rig"


def seeds() -> Iterable[bytes]:
    """Everything, little, and the demo's."""
    yield FULL.encode()
    yield MINIMAL.encode()
    yield (CELL / "rig.yaml").read_bytes()
    yield b"%YAML 1.2\n---\n" + MINIMAL.replace("hand", '"h\\u00e4nd"').encode() + b"...\n"


HARNESS = Harness(read, seeds, words_and_lines)
