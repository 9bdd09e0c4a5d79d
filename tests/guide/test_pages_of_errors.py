"""The page that an error names is there, with its heading, and the command says it after the message."""

from __future__ import annotations

import inspect
from pathlib import Path

import pytest
from given_commands import command
from guide.test_links import guide
from places import REPOSITORY

from gtsam_rwhec import errors

CLASSES = [kind for _name, kind in inspect.getmembers(errors, inspect.isclass) if issubclass(kind, errors.RwhecError)]


@pytest.mark.parametrize("kind", CLASSES, ids=lambda kind: kind.__name__)
def test_the_page_is_there(kind: type[errors.RwhecError]) -> None:
    path, _, anchor = kind.page.partition("#")
    if path:
        text = (REPOSITORY / path).read_text(encoding="utf-8")
        assert not anchor or anchor in guide.anchors(text)


def test_errors_of_files_have_a_page() -> None:
    assert all(kind.page for kind in CLASSES if issubclass(kind, errors.FileFormatError))


def test_the_command_names_it(tmp_path: Path) -> None:
    (tmp_path / "rig.yaml").write_text("sensorz: {}\n", encoding="utf-8")
    status, said = command("calibrate", "run.mcap", "--rig", tmp_path / "rig.yaml", "-o", tmp_path / "out")
    assert status == 2
    assert said.startswith("Error: ")
    assert said.endswith("More: docs/rig_file.md")
