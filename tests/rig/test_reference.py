"""The reference of rig files says every key, and is up to date."""

from __future__ import annotations

import re

from places import REPOSITORY

from gtsam_rwhec.rig import reference_text
from gtsam_rwhec.rig.rig_reference import rig_file_schema, target_sections


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
    for section in target_sections():
        counted = getattr(section, "counted", "")
        if counted:
            assert "across, down" in str(section.model_fields[counted].description), section
        assert not {"columns", "rows"} & set(section.model_fields), section
