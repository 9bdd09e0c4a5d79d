"""An earlier output of the same log is replaced without asking, and nothing else."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from gtsam_rwhec.errors import LogError
from gtsam_rwhec.pipeline import check_replaceable

GOLDEN = Path(__file__).parents[1] / "golden"


def test_a_folder_that_is_missing_empty_or_has_other_files_is_free(tmp_path: Path) -> None:
    check_replaceable(tmp_path / "nowhere", "eye_to_hand.mcap")
    (tmp_path / "notes.txt").write_text("mine", encoding="utf-8")
    check_replaceable(tmp_path, "eye_to_hand.mcap")


def test_the_output_of_the_same_log_may_be_replaced(tmp_path: Path) -> None:
    shutil.copy(GOLDEN / "result_version_3.json", tmp_path / "result.json")
    (tmp_path / "tf.yaml").write_text("", encoding="utf-8")
    check_replaceable(tmp_path, "eye_to_hand.mcap")
    with pytest.raises(LogError, match=r"not from an earlier run on other.mcap: result.json. Give another folder"):
        check_replaceable(tmp_path, "other.mcap")


@pytest.mark.parametrize("name", ["result.json", "clean.mcap", "detected.mcap", "tf.yaml"])
def test_what_cannot_be_recognised_is_refused(name: str, tmp_path: Path) -> None:
    (tmp_path / name).write_bytes(b"somebody else's")
    with pytest.raises(LogError, match=f"not from an earlier run on a.mcap: {name}"):
        check_replaceable(tmp_path, "a.mcap")
    assert (tmp_path / name).read_bytes() == b"somebody else's"


def test_one_foreign_file_beside_known_ones_is_refused(tmp_path: Path) -> None:
    shutil.copy(GOLDEN / "result_version_3.json", tmp_path / "result.json")
    (tmp_path / "detected.mcap").write_bytes(b"cut off")
    with pytest.raises(LogError, match=r": detected\.mcap"):
        check_replaceable(tmp_path, "eye_to_hand.mcap")
