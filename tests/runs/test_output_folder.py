"""What is in an output folder before a run, and which stages a changed rig file asks for: gone on with, or refused."""

from __future__ import annotations

from pathlib import Path

import pytest

from gtsam_rwhec.errors import FileFormatError, LogError
from gtsam_rwhec.rig import parse_rig
from gtsam_rwhec.runs import output_folder as earlier_output
from gtsam_rwhec.runs.changed_rig import changes
from gtsam_rwhec.runs.output_folder import (
    LIST_FILE,
    MOST_NAMED,
    earlier_run,
    list_written,
    output_folder,
    remove_unchanged,
)

LOG = "run.mcap"
ALL = (
    "result.json", "calibration.mcap", "static_tf.launch.py", "tf.yaml", "rig.urdf.xacro",
    "camchain.yaml", "cameras.opencv.yaml", "cameras.txt", "camera_info/cam_0.yaml",
)  # fmt: skip


def run(
    folder: Path,
    *names: str,
    log: str = LOG,
    content: bytes = b"output",
    replace: bool = False,
    ends_with: BaseException | None = None,
    sources: tuple[Path, ...] = (),
) -> None:
    """What a calibration does: it writes files while the folder is its own."""
    with output_folder(folder, log, replace=replace, sources=sources) as output:
        output.begin()
        for name in names:
            (folder / name).parent.mkdir(exist_ok=True)
            (folder / name).write_bytes(content)
        if ends_with is not None:
            raise ends_with


def interrupted(folder: Path, *names: str, ends_with: BaseException | None = None, **options: str) -> None:
    """A run that ends early."""
    error = KeyboardInterrupt() if ends_with is None else ends_with
    with pytest.raises(type(error)):
        run(folder, *names, ends_with=error, **options)  # type: ignore[arg-type]


def contents(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def test_a_finished_calibration_is_replaced_on_request_only(tmp_path: Path) -> None:
    out = tmp_path / "new" / "folder"
    run(out, *ALL, content=b"first")
    assert earlier_run(out) == (LOG, "finished")
    assert not (out / "detected.mcap").exists()  # the others have all that was in it
    before = contents(out)
    with pytest.raises(LogError, match=rf"has a finished calibration of {LOG}, and nothing was changed.*--force"):
        run(out, *ALL, content=b"second")
    assert contents(out) == before
    run(out, *ALL, content=b"second", replace=True)
    run(out, *ALL, content=b"third", replace=True, log="other.mcap")
    assert contents(out)["camera_info/cam_0.yaml"] == b"third"
    assert earlier_run(out) == ("other.mcap", "finished")


@pytest.mark.parametrize("replace", [False, True])
def test_a_folder_with_anything_else_is_refused(tmp_path: Path, replace: bool) -> None:
    for number in range(MOST_NAMED + 2):
        (tmp_path / f"mine_{number}.txt").write_text("mine", encoding="utf-8")
    before = contents(tmp_path)
    with pytest.raises(LogError, match=r"not of a calibration.*mine_0\.txt, mine_1\.txt.* and 2 more\. Give another"):
        run(tmp_path, *ALL, replace=replace)
    assert contents(tmp_path) == before


def test_other_files_beside_a_calibration_stay(tmp_path: Path) -> None:
    run(tmp_path, *ALL)
    (tmp_path / "notes.txt").write_text("mine", encoding="utf-8")
    run(tmp_path, *ALL, replace=True)
    assert (tmp_path / "notes.txt").read_text(encoding="utf-8") == "mine"
    interrupted(tmp_path / "unfinished", "tf.yaml")
    (tmp_path / "unfinished" / "camera_info").mkdir()
    (tmp_path / "unfinished" / "camera_info" / "notes.txt").write_bytes(b"mine")
    with pytest.raises(LogError, match=r"not of a calibration.*camera_info/notes\.txt"):
        run(tmp_path / "unfinished")


@pytest.mark.parametrize("name", [*ALL, LIST_FILE, "detections.jsonl"])
def test_what_cannot_be_recognised_is_never_replaced(name: str, tmp_path: Path) -> None:
    (tmp_path / name).parent.mkdir(exist_ok=True)
    (tmp_path / name).write_bytes(b"somebody else's")
    for replace in (False, True):
        with pytest.raises(LogError, match=f"that no earlier calibration wrote there.*: {name}. Give another"):
            run(tmp_path, name, replace=replace)
    assert contents(tmp_path) == {name: b"somebody else's"}


@pytest.mark.parametrize("name", ALL)
def test_a_foreign_or_changed_file_beside_known_ones_is_never_replaced(name: str, tmp_path: Path) -> None:
    run(tmp_path, *(other for other in ALL if other != name))
    (tmp_path / name).parent.mkdir(exist_ok=True)
    (tmp_path / name).write_bytes(b"somebody else's")
    with pytest.raises(LogError, match=f"was changed: {name}. Give"):
        run(tmp_path, replace=True)
    (tmp_path / name).unlink()
    run(tmp_path, *ALL, replace=True)
    (tmp_path / name).write_bytes(b"changed")
    with pytest.raises(LogError, match=f"was changed: {name}. Give"):
        run(tmp_path, replace=True)


def test_a_link_and_a_folder_in_the_place_of_a_file_are_refused(tmp_path: Path) -> None:
    (tmp_path / "tf.yaml").symlink_to(tmp_path / "nothing")
    (tmp_path / "camchain.yaml").mkdir()
    (tmp_path / "camera_info").write_text("mine", encoding="utf-8")
    with pytest.raises(LogError, match=r"was changed: camchain\.yaml, camera_info, tf\.yaml\."):
        run(tmp_path)


def test_an_unfinished_run_is_gone_on_with(tmp_path: Path) -> None:
    """Also one that was killed in the middle of a file, when it could not bring its list up to date."""
    interrupted(tmp_path, "tf.yaml")
    (tmp_path / "result.json").write_bytes(b"written just before the end")
    (tmp_path / "camera_info").mkdir(exist_ok=True)
    for part in (".calibration.mcap.123.part", "camera_info/.cam_0.yaml.123.part"):
        (tmp_path / part).write_bytes(b"half")
    with pytest.raises(LogError, match=rf"unfinished run on {LOG}, which is not other\.mcap.*Give {LOG}.*--force"):
        run(tmp_path, *ALL, log="other.mcap")
    assert (tmp_path / ".calibration.mcap.123.part").exists()
    run(tmp_path, *ALL)
    assert earlier_run(tmp_path) == (LOG, "finished")
    assert not list(tmp_path.rglob("*.part"))


def test_who_mended_the_inputs_of_a_run_that_failed_need_not_ask(tmp_path: Path) -> None:
    interrupted(tmp_path, "tf.yaml", ends_with=LogError("a wrong rig file"))
    assert contents(tmp_path).keys() == {LIST_FILE, "tf.yaml"}
    run(tmp_path, *ALL, log="other.mcap")


@pytest.mark.parametrize("error", [LogError("a wrong rig file"), KeyboardInterrupt(), ZeroDivisionError()])
def test_an_empty_folder_is_not_left_behind(error: BaseException, tmp_path: Path) -> None:
    interrupted(tmp_path / "new" / "folder", ends_with=error)
    assert not list(tmp_path.iterdir())
    interrupted(tmp_path, ends_with=error)
    assert tmp_path.is_dir()  # it was there
    assert not list(tmp_path.iterdir())


def test_the_error_is_said_and_not_what_follows_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A full disk: nothing can be written any more, not the list either. The folder's run stays unfinished."""

    def full(path: Path, content: bytes) -> None:
        raise FileFormatError(f"{path} cannot be written: No space left on device.")

    def fails() -> None:
        with output_folder(tmp_path, LOG, replace=False) as output:
            output.begin()
            (tmp_path / "tf.yaml").write_bytes(b"output")
            monkeypatch.setattr(earlier_output, "write_atomically", full)
            raise LogError("the first error")

    with pytest.raises(LogError, match="the first error"):
        fails()
    monkeypatch.undo()
    assert earlier_run(tmp_path) == (LOG, "unfinished")
    run(tmp_path, *ALL)


def test_the_log_itself_is_not_foreign(tmp_path: Path) -> None:
    for name in ("detected.mcap", "cleaned.mcap"):
        (tmp_path / name).write_bytes(b"a stage's log")
    sources = tmp_path / "detected.mcap", tmp_path / "cleaned.mcap"
    run(tmp_path, *(name for name in ALL if name != "detected.mcap"), sources=sources)
    assert (tmp_path / "detected.mcap").read_bytes() == b"a stage's log"


def test_files_of_single_stages_are_listed(tmp_path: Path) -> None:
    (tmp_path / "tf.yaml").write_bytes(b"exported")
    list_written(tmp_path, ["a.mcap", "b.mcap"], [tmp_path / "tf.yaml", tmp_path / "not_written"])
    assert earlier_run(tmp_path) == ("a.mcap, b.mcap", "finished")
    run(tmp_path, "tf.yaml", replace=True)


def test_files_of_cameras_that_are_gone_are_removed_and_nobody_elses(tmp_path: Path) -> None:
    names = [f"camera_info/{name}.yaml" for name in ("kept", "gone", "changed")]
    run(tmp_path, *ALL, *names)
    (tmp_path / "camera_info" / "changed.yaml").write_bytes(b"changed")
    (tmp_path / "camera_info" / "mine.yaml").write_bytes(b"output")
    remove_unchanged(tmp_path, ["camera_info"], keep=[tmp_path / "camera_info" / "kept.yaml"])
    assert {path.name for path in (tmp_path / "camera_info").iterdir()} == {"kept.yaml", "changed.yaml", "mine.yaml"}
    assert (tmp_path / "tf.yaml").exists()
    with pytest.raises(LogError, match=r"was changed: camera_info/changed\.yaml, camera_info/mine\.yaml\. Give"):
        run(tmp_path, *ALL, replace=True)
    for name in ("changed", "mine"):
        (tmp_path / "camera_info" / f"{name}.yaml").unlink()
    remove_unchanged(tmp_path, ["camera_info"])
    assert not (tmp_path / "camera_info").exists()
    remove_unchanged(tmp_path / "nothing", ["camera_info"])


def test_two_runs_at_once_are_refused(tmp_path: Path) -> None:
    pytest.importorskip("fcntl")
    with output_folder(tmp_path, LOG, replace=True), pytest.raises(LogError, match="another run is at work in this"):
        run(tmp_path, replace=True)


RIG = """\
carriers: {sensors: hand, targets: base, poses: {tf: [base, hand]}}
sensors: {cam: {images: /image, intrinsics: {file: camera.yaml, stated: nominal}}}
targets: {tag: {type: tag, family: tag36h11, id: 3, size_m: 0.1}}
"""


@pytest.mark.parametrize(
    ("right", "other", "detection", "cleaning"),
    [
        ("nominal", "calibration", (), ()),  # refinement alone asks it
        ("file: camera.yaml", "file: other.yaml", ("sensors.cam.intrinsics",), ()),
        ("size_m: 0.1", "size_m: 0.2", ("targets.tag",), ()),
        ("tf: [base, hand]", "tf: [hand, base]", (), ("carriers.poses",)),
    ],
)
def test_keys_ask_for_their_stage(
    right: str, other: str, detection: tuple[str, ...], cleaning: tuple[str, ...]
) -> None:
    assert right in RIG
    found = changes(parse_rig(RIG, "rig.yaml"), parse_rig(RIG.replace(right, other), "rig.yaml"))
    assert (found.detection, found.cleaning) == (detection, cleaning)
