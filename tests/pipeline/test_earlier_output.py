"""An earlier output of the same log is replaced without asking, and nothing else."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from gtsam_rwhec.errors import LogError
from gtsam_rwhec.pipeline import replacing_output

GOLDEN = Path(__file__).parents[1] / "golden"
LOG = "eye_to_hand.mcap"
ALL = (
    "result.json", "clean.mcap", "detected.mcap", "static_tf.launch.py", "tf.yaml", "rig.urdf.xacro", "camchain.yaml",
    "plots/frames.png", "plots/residuals.png", "plots/coverage.png", "plots/deviations.png",
)  # fmt: skip


def run(folder: Path, *names: str, log: str = LOG, content: bytes = b"output") -> None:
    """What a calibration does: it writes files while the folder is known to be free."""
    with replacing_output(folder, log):
        for name in names:
            (folder / name).parent.mkdir(exist_ok=True)
            (folder / name).write_bytes(content)


def test_a_folder_that_is_missing_empty_or_has_other_files_is_free(tmp_path: Path) -> None:
    run(tmp_path / "new" / "folder")
    (tmp_path / "notes.txt").write_text("mine", encoding="utf-8")
    run(tmp_path)


def test_the_output_of_the_same_log_may_be_replaced(tmp_path: Path) -> None:
    for content in (b"first", b"second", b"third"):
        run(tmp_path, *ALL, content=content)
    with pytest.raises(LogError, match=r"not from an earlier run on other.mcap, .*: result.json, .*tf.yaml, .*another"):
        run(tmp_path, log="other.mcap")


@pytest.mark.parametrize("name", [*ALL, ".written.json"])
def test_what_cannot_be_recognised_is_refused(name: str, tmp_path: Path) -> None:
    (tmp_path / name).parent.mkdir(exist_ok=True)
    (tmp_path / name).write_bytes(b"somebody else's")
    with pytest.raises(LogError, match=f"not from an earlier run on {LOG}, or were changed since: {name}. Give"):
        run(tmp_path, name)
    assert (tmp_path / name).read_bytes() == b"somebody else's"
    assert len([path for path in tmp_path.rglob("*") if path.is_file()]) == 1


@pytest.mark.parametrize("name", ALL)
def test_a_foreign_or_changed_file_beside_known_ones_is_refused(name: str, tmp_path: Path) -> None:
    run(tmp_path, *(other for other in ALL if other != name))
    (tmp_path / name).write_bytes(b"somebody else's")
    with pytest.raises(LogError, match=f"since: {name}. Give"):
        run(tmp_path)
    (tmp_path / name).unlink()
    run(tmp_path, name)
    (tmp_path / name).write_bytes(b"changed")
    with pytest.raises(LogError, match=f"since: {name}. Give"):
        run(tmp_path)


def test_a_result_of_the_log_does_not_excuse_what_is_beside_it(tmp_path: Path) -> None:
    shutil.copy(GOLDEN / "result_version_3.json", tmp_path / "result.json")
    (tmp_path / "tf.yaml").write_text("mine", encoding="utf-8")
    with pytest.raises(LogError, match=r"since: result\.json, tf\.yaml\."):
        run(tmp_path)


def test_a_link_and_a_folder_in_the_place_of_a_file_are_refused(tmp_path: Path) -> None:
    (tmp_path / "tf.yaml").symlink_to(tmp_path / "nothing")
    (tmp_path / "camchain.yaml").mkdir()
    (tmp_path / "plots").write_text("mine", encoding="utf-8")
    with pytest.raises(LogError, match=r"since: tf\.yaml, camchain\.yaml, plots\."):
        run(tmp_path)


def test_an_interrupted_run_is_taken_up(tmp_path: Path) -> None:
    def interrupted() -> None:
        with replacing_output(tmp_path, LOG):
            (tmp_path / "tf.yaml").write_text("half of the output", encoding="utf-8")
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    run(tmp_path, *ALL)


def test_a_killed_run_is_taken_up_where_files_name_the_log(tmp_path: Path) -> None:
    with replacing_output(tmp_path, LOG):
        at_the_start = (tmp_path / ".written.json").read_bytes()
        shutil.copy(GOLDEN / "result_version_3.json", tmp_path / "result.json")
    (tmp_path / ".written.json").write_bytes(at_the_start)
    run(tmp_path)
