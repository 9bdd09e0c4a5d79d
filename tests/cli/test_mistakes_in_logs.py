"""Mistakes of a first user with logs, CSV files and samples: exit status not 0, the fault and its cure in words."""

from __future__ import annotations

import dataclasses
import re
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import synthetic_logs as made
from given_commands import command
from places import DEMO
from rwhec_factors import se3
from scipy.spatial.transform import Rotation

pytestmark = pytest.mark.usefixtures("without_figures")

Change = Callable[[Path], object]


@pytest.fixture(scope="session")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A log of two cameras' detections of three tags."""
    return made.write(tmp_path_factory.mktemp("mistakes") / "run.mcap", made.recording(3.0))


def moved(message: made.Message) -> made.Message:
    """From the middle on tag 1 is 0.1 m aside, and turned."""
    if "detections" not in message.content or message.logged_ns < made.BEGIN_NS + 15 * 10**8:
        return message
    parts = []
    for part in message.content["detections"]:
        if part["id"] == "1":
            at, turn = part["pose"]["position"], part["pose"]["orientation"]
            R = Rotation.from_quat([turn[key] for key in "xyzw"])
            T = se3.pose(R.as_matrix(), [at[key] for key in "xyz"])
            part = made.tag(1, T @ made.pose((0, 0, 25), (0.1, 0.03, 0.0)))
        parts.append(part)
    return dataclasses.replace(message, content=message.content | {"detections": parts})


def test_a_tag_that_moved_half_way(tmp_path: Path) -> None:
    (tmp_path / "rig.yaml").write_text(made.RIG, encoding="utf-8")
    log = made.write(tmp_path / "run.mcap", map(moved, made.recording(3.0)))
    status, said = command("calibrate", log, "--rig", tmp_path / "rig.yaml", "-o", tmp_path / "out")
    assert status == 6, said
    assert re.search(r"\d+ of 28 measurements of tag_1 contradict the answer", said)
    assert "tag_1 was at two poses: its measurements fall into groups of 14 and 14" in said


LOGS = {
    "a topic that is not there": (
        made.rig_text(cam_1="detections: /cam_2/tags"), 2, ("/cam_2/tags", "has: /cam_0/tags"),
    ),
    "a frame that tf does not have": (
        made.rig_text(poses="{tf: [base, hand_link]}").replace("sensors: hand", "sensors: hand_link"), 2,
        ("hand_link", "there are: base, hand"),
    ),
    "a late clock": (
        made.rig_text(cam_1="detections: /cam_1/tags\n    time_offset: 0.3"), 6,
        ("the time offset of cam_1 is 0.3 s in the rig file", "write time_offset: estimate"),
    ),
    "a wrong number of a tag": (
        made.rig_text(tag_1=f"{{type: tag, family: tag36h11, id: 7, size_m: {made.SIZE_M}}}"), 6,
        ("tag_1: 0 measurements (no sensor saw it)", "tag36h11 1 (28 times)"),
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", LOGS)
def test_of_a_log(name: str, log: Path, tmp_path: Path) -> None:
    rig, wanted, words = LOGS[name]
    (tmp_path / "rig.yaml").write_text(rig, encoding="utf-8")
    status, said = command("calibrate", log, "--rig", tmp_path / "rig.yaml", "-o", tmp_path / "out")
    assert status == wanted, said
    for part in words:
        assert part in said


def rows(change: Callable[[np.ndarray], np.ndarray], side: str) -> Change:
    """Other rows qw, qx, qy, qz, tx, ty, tz in the files of A or B."""

    def changed(folder: Path) -> None:
        for path in folder.glob(f"*_{side}.csv"):
            np.savetxt(path, change(np.loadtxt(path, delimiter=",")), delimiter=",")

    return changed


def inverse(given: np.ndarray) -> np.ndarray:
    R = Rotation.from_quat(given[:, [1, 2, 3, 0]]).inv()
    return np.hstack([R.as_quat()[:, [3, 0, 1, 2]], -R.apply(given[:, 4:])])


TABLES = {
    "quaternions x, y, z, w": (rows(lambda row: row[:, [1, 2, 3, 0, 4, 5, 6]], "B"), (),
                               ("the quaternions of B are xyzw, and were read as wxyz", "order='xyzw'")),
    "A inverted": (rows(inverse, "A"), (), ("A is inverted", "give A = T_sensorcarrier_targetcarrier")),
    "A in millimetres": (rows(lambda row: row * [1, 1, 1, 1, 1000, 1000, 1000], "A"), (),
                         ("A is in millimetres", "divide the translations of A by 1000")),
    "roles exchanged": (lambda _: None, ("--targets", "cam", "--sensors", "tag"),
                        ("targets and sensors are exchanged", "name the targets as targets")),
}  # fmt: skip


@pytest.mark.parametrize("name", TABLES)
def test_of_csv_files(name: str, tmp_path: Path) -> None:
    change, options, words = TABLES[name]
    folder = Path(shutil.copytree(DEMO, tmp_path / "demo"))
    change(folder)
    if options:  # the same files, named the other way round
        for path in [*folder.iterdir()]:
            tag, cam = path.stem.split("_")[1::2][:2]
            path.rename(folder / f"cam_{cam}_tag_{tag}_{path.stem[-1]}.csv")
    status, said = command("calibrate", folder, *options)
    assert status == 6, said
    for part in words:
        assert part in said


def test_rows_that_slipped_are_repaired_on_request(tmp_path: Path) -> None:
    """One of eleven pairs: its B lacks the row of an image without a detection, and its A the last row."""
    folder = Path(shutil.copytree(DEMO, tmp_path / "demo"))
    lost = 6
    for path in folder.glob("tag_0_cam_0_?.csv"):
        rows = path.read_text(encoding="utf-8").splitlines(keepends=True)
        del rows[lost if path.stem.endswith("B") else -1]
        path.write_text("".join(rows), encoding="utf-8")
    status, said = command("calibrate", folder)
    assert status == 6, said
    said = " ".join(said.split())
    assert f"from row {lost + 1} of tag_0-cam_0 on, B belongs to the A that is 1 row later (11 rows)" in said
    status, said = command("calibrate", folder, "--repair", "-o", tmp_path / "result.json")
    assert status == 0, said
    assert (tmp_path / "report.html").is_file()  # of the rows where they belong, one fewer than were read
    assert "Use these poses with care: 10 rows were shifted and 1 left out" in " ".join(said.split())
    status, said = command("calibrate", DEMO, "--repair")
    assert (status, "--repair: no rows slipped" in said) == (0, True)
    status, said = command("calibrate", folder, "--repair", "--as-read")
    assert (status, "give one" in said) == (2, True)


def test_joint_states_are_no_samples(tmp_path: Path) -> None:
    """MoveIt's panel saves both, side by side."""
    (tmp_path / "joints.yaml").write_text("joint_names: [a, b]\njoint_values:\n  - [0.1, 0.2]\n  - [0.3, 0.4]\n")
    status, said = command("calibrate", tmp_path / "joints.yaml", "-o", tmp_path / "result.json")
    assert status == 2
    assert "has no hand-eye samples. Samples have, with names of MoveIt: effector_wrt_world" in said
    assert not (tmp_path / "result.json").exists()
