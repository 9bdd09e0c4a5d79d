"""What ``convert`` says of a log: which types of messages the next step passes over."""

from __future__ import annotations

from pathlib import Path

import synthetic_logs as made

from gtsam_rwhec.cli.convert_command import MOST_NAMED, messages_not_read


def test_types_that_the_next_step_does_not_read_are_named(tmp_path: Path) -> None:
    known = made.recording(1.0)
    assert not messages_not_read(made.write(tmp_path / "known.mcap", known))
    others = [made.Message(f"/of_{i}", "nav.Thing", {"a": 1}, made.BEGIN_NS + i) for i in range(3)]
    said = messages_not_read(made.write(tmp_path / "log.mcap", [*known, *others]))
    assert "does not read nav.Thing (3)" in said
    assert "TagDetections" not in said


def test_of_many_types_the_first_are_named(tmp_path: Path) -> None:
    others = [made.Message(f"/of_{i}", f"nav.Thing{i:02d}", {}, made.BEGIN_NS) for i in range(MOST_NAMED + 2)]
    assert "and 2 more types" in messages_not_read(made.write(tmp_path / "log.mcap", others))
