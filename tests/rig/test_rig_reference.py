"""The reference of rig files says every key, and is up to date."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import jsonschema
import pytest
from places import REPOSITORY
from rig_texts import FULL, MINIMAL

from gtsam_rwhec.errors import RigError
from gtsam_rwhec.files.yaml_lines import parse_yaml
from gtsam_rwhec.rig import SCHEMA_FILE, editor_line, parse_rig, reference_text, rig_file_schema, schema_text
from gtsam_rwhec.rig.target_sections import KINDS


def test_the_page_is_up_to_date() -> None:
    said = "the fields changed: gtsam-rwhec init --reference > docs/rig_file.md"
    assert (REPOSITORY / "docs" / "rig_file.md").read_text(encoding="utf-8") == reference_text(), said


def test_every_key_has_a_row_with_words_and_an_example() -> None:
    rows = re.findall(r"^\| `(\w+)` \| (.*) \|$", reference_text(), re.MULTILINE)
    schema = rig_file_schema()
    keys = [key for section in (schema, *schema["$defs"].values()) for key in section["properties"]]
    keys += schema["properties"]["detection"]["properties"]
    assert sorted(key for key, _ in rows) == sorted(keys)
    for key, row in rows:
        is_, value, _, default, example = row.split(" | ")
        assert is_, key
        assert value, key
        assert example.startswith(f"`{key}: "), key
        if key.endswith(("_m", "_mm", "_deg", "_px", "_s")):
            assert row.split(" | ")[2], f"{key} has no unit"
        assert default or example


def test_boards_say_what_they_count() -> None:
    for section in KINDS.values():
        counted = getattr(section, "counted", "")
        if counted:
            assert "across, down" in str(section.model_fields[counted].description), section
        assert not {"columns", "rows"} & set(section.model_fields), section


VALIDATOR = jsonschema.Draft7Validator(rig_file_schema())
FOLDER = """\
carriers: {sensors: base, targets: hand, poses: {frames: [base, hand], euler: ZYX, angles: degrees, length: mm}}
sensors:
  a: {images: a/image, poses: a/pose, intrinsics: a.yaml}
  b: {images: b/image, poses: b/pose, intrinsics: {K: [550, 550, 320, 240], size: [640, 480]}}
targets:
  dots: {type: circle_grid, circles: [10, 10], spacing_m: 0.0254, larger_dot: true}
"""
IN_PAGES = [
    pytest.param(block, id=f"{page.stem}-{i}")
    for page in sorted((REPOSITORY / "docs").glob("*.md"))
    for i, block in enumerate(re.findall(r"```yaml\n(.*?)```", page.read_text(encoding="utf-8"), re.DOTALL))
    if "carriers:" in block or "reference:" in block
]


def faults(text: str) -> list[str]:
    return [error.message for error in VALIDATOR.iter_errors(lists(parse_yaml(text, "rig.yaml").data))]


def lists(node: Any) -> Any:
    """The same values, with lists where the reader has tuples."""
    if isinstance(node, dict):
        return {key: lists(value) for key, value in node.items()}
    return [lists(value) for value in node] if isinstance(node, tuple) else node


def test_the_schema_is_one_and_its_file_is_up_to_date() -> None:
    jsonschema.Draft7Validator.check_schema(rig_file_schema())
    said = "the fields changed: gtsam-rwhec init --schema > gtsam_rwhec/rig/rig_file.schema.json"
    assert SCHEMA_FILE.read_text(encoding="utf-8") == schema_text(), said
    assert editor_line().endswith("/gtsam_rwhec/rig/rig_file.schema.json\n")


@pytest.mark.parametrize("path", sorted((REPOSITORY / "data").rglob("*.yaml")), ids=lambda path: path.name)
def test_rig_files_of_the_repository_are_valid(path: Path) -> None:
    assert faults(path.read_text(encoding="utf-8")) == []


@pytest.mark.parametrize("text", [FULL, MINIMAL, FOLDER], ids=["full", "minimal", "folder"])
def test_what_reading_takes_is_valid(text: str) -> None:
    parse_rig(text, "rig.yaml")
    assert faults(text) == []


@pytest.mark.parametrize("text", IN_PAGES)
def test_rig_files_of_the_pages_are_valid(text: str) -> None:
    assert faults(text) == []


@pytest.mark.parametrize(
    ("text", "right", "wrong"),
    [
        (FULL, "max_gap_s:", "max_gap:"),
        (FULL, "family: tag36h11, id: 0", "family: tag36h12, id: 0"),
        (FULL, "id: 0, size_m", "id: zero, size_m"),
        (FULL, "size_m: 0.12", "size_m: 120"),
        (FULL, "square_m: 0.041", "square_m: 0"),
        (FULL, "squares: [7, 5]", "columns: 7, rows: 5"),
        (FULL, "squares: [7, 5]", "squares: [7]"),
        (FULL, "inner_corners: [9, 6]", "squares: [9, 6]"),
        (FULL, "tf: [base, hand]", "tf: [base, hand], topic: /pose, parent: base, child: hand"),
        (FULL, "tf: [base, hand]", "topic: /pose, parent: base"),
        (FULL, "sensors: hand", "sensors: 1hand"),
        (FULL, "time_offset: estimate", "time_offset: guess"),
        (FOLDER, "intrinsics: a.yaml", "frame: f"),
        (FOLDER, "intrinsics: a.yaml", "intrinsics: {file: a.yaml, stated: factory}"),
        (FULL, "images: /cam_left/image", "images: /cam_left/image\n    detections: /tags"),
        (FULL, "sizes: check", "sizes: maybe"),
        (FULL, "noise: estimate", "noise: {rotation_deg: 1}"),
        (FULL, "{min_side_px: 18", "{min_side: 18"),
        (FULL, "type: tag,", ""),
        (FOLDER, "euler: ZYX", "euler: yaw"),
        (FOLDER, "frames: [base, hand]", "tf: [base, hand]"),
        (FOLDER, "larger_dot: true", "larger_dot: below"),
        (FOLDER, "larger_dot: true", "larger: true"),
    ],
    ids=lambda value: value if len(value) < 60 else "",
)
def test_what_is_wrong_is_refused_as_reading_refuses_it(text: str, right: str, wrong: str) -> None:
    assert right in text
    with pytest.raises(RigError):
        parse_rig(text.replace(right, wrong, 1), "rig.yaml")
    assert faults(text.replace(right, wrong, 1)) != []


def test_every_example_is_valid_where_it_stands() -> None:
    schema = rig_file_schema()
    checked = 0

    def walk(node: dict[str, Any]) -> None:
        nonlocal checked
        for said in node.get("properties", {}).values():
            for example in said.get("examples", ()):
                bare = {key: value for key, value in said.items() if key != "examples"}
                jsonschema.validate(example, {"$defs": schema["$defs"], **bare}, jsonschema.Draft7Validator)
                checked += 1

    walk(schema)
    for section in schema["$defs"].values():
        walk(section)
    assert checked > 50
