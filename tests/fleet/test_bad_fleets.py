"""What is wrong is a row with a sentence where it concerns one robot, and an error where it concerns all of them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
from fleets import MadeFleet, write_fleet

import gtsam_rwhec as rw
from gtsam_rwhec import fleet
from gtsam_rwhec.fleet.fleet_rows import ROWS_FILE
from gtsam_rwhec.fleet.manifest import read_rig_source


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> MadeFleet:
    return write_fleet(tmp_path_factory.mktemp("fleet"), 2, 1, images=8, tags=2, corners=False)


def manifest(made: MadeFleet, text: str) -> fleet.Manifest:
    return fleet.parse_manifest(text, made.manifest)


def test_what_concerns_one_robot_is_a_row(made: MadeFleet, tmp_path: Path) -> None:
    """A log that is not there, a pattern without logs, a rig file that is not there or has faults."""
    folder = Path(made.manifest).parent
    (folder / "faulty.yaml").write_text(Path(made.rig).read_text(encoding="utf-8").replace("size_m", "size_mm"))
    given = manifest(
        made,
        "rig: rig.yaml\nrobots:\n"
        '  gone: logs/none.mcap\n  empty: "logs/*.nothing"\n'
        "  rigless: {logs: logs/robot_000/night_00.mcap, rig: none.yaml}\n"
        "  faulty: {logs: logs/robot_001/night_00.mcap, rig: faulty.yaml}\n",
    )
    run = fleet.run(given, str(tmp_path))
    said = {row.robot: str(row.failure) for row in run.rows}
    assert not run.is_fine
    assert f"{folder}/logs/none.mcap" in said["gone"]
    assert f"no log matches {folder}/logs/*.nothing ({made.manifest}, line 4: robots.empty)" in said["empty"]
    assert f"{folder}/none.yaml" in said["rigless"]
    assert "size_mm: unknown key; did you mean size_m?" in said["faulty"]
    assert fleet.read_fleet(str(tmp_path))[0].failure == said["gone"]


def test_what_concerns_all_is_an_error(made: MadeFleet, tmp_path: Path) -> None:
    given = fleet.read_manifest(made.manifest)
    with pytest.raises(rw.errors.RigError, match=r"none\.yaml"):
        fleet.run(replace(given, shared_rig=f"{tmp_path}/none.yaml"), str(tmp_path))
    log = "logs/robot_000/night_00.mcap"
    with pytest.raises(rw.errors.ManifestError, match=r"night_00\.mcap is a log of a and of b; a log is of one robot"):
        fleet.run(manifest(made, f"rig: rig.yaml\nrobots: {{a: {log}, b: {log}}}"), str(tmp_path))
    other = f"{{log: {log}, rig: other.yaml}}"
    with pytest.raises(rw.errors.ManifestError, match=r"a log of a with .*rig\.yaml and with .*other\.yaml; give it"):
        fleet.run(manifest(made, f"rig: rig.yaml\nrobots: {{a: [{log}, {other}]}}"), str(tmp_path))


def test_rig_files_of_a_site_that_contradict_each_other(made: MadeFleet, tmp_path: Path) -> None:
    folder = Path(made.manifest).parent
    (folder / "smaller.yaml").write_text(Path(made.rig).read_text(encoding="utf-8").replace("0.12", "0.1199999"))
    given = manifest(
        made,
        "rig: rig.yaml\nrobots:\n  a: logs/robot_000/night_00.mcap\n"
        "  b: {rig: smaller.yaml, logs: logs/robot_001/night_00.mcap}\nsites: {hall: [a, b]}\n",
    )
    run = fleet.run(given, str(tmp_path))
    assert [(row.robot, row.unit) for row in run.rows] == [("a", "hall"), ("b", "hall")]
    for row in run.rows:
        assert row.failure is not None
        assert "target tag_0 differs between" in row.failure
        assert "smaller.yaml" in row.failure
    assert "tag_0" in str(fleet.read_fleet(str(tmp_path))[0].failure)


def test_results_of_another_version_are_not_used_and_said(made: MadeFleet, tmp_path: Path) -> None:
    (tmp_path / ROWS_FILE).write_bytes(fleet.rows_json([]).replace(b'version": 1', b'version": 99'))
    told: list[str] = []
    given = manifest(made, "rig: rig.yaml\nrobots:\n  a: none.mcap\n")
    run = fleet.run(given, str(tmp_path), progress=told.append)
    assert "has rows of format 99" in run.remarks[0]
    assert "They are not used: everything is done anew" in run.remarks[0]
    assert run.remarks[0] in told
    assert len(fleet.read_fleet(str(tmp_path))) == 1


def test_rig_files_travel_with_the_files_that_they_name(tmp_path: Path) -> None:
    """A worker elsewhere has only the bytes: intrinsics beside, and above, the rig file."""
    (tmp_path / "rigs").mkdir()
    kalibr = (
        "cam0:\n  camera_model: pinhole\n  intrinsics: [400.0, 400.0, 320.0, 240.0]\n  distortion_model: radtan\n"
        "  distortion_coeffs: [0.0, 0.0, 0.0, 0.0]\n  resolution: [640, 480]\n"
    )
    (tmp_path / "camchain.yaml").write_text(kalibr)
    text = (
        "carriers: {sensors: hand, targets: base, poses: {tf: [base, hand]}}\n"
        "sensors:\n  cam: {images: /image, intrinsics: ../camchain.yaml}\n"
        "targets:\n  tag: {type: tag, family: tag36h11, id: 0, size_m: 0.1}\n"
    )
    (tmp_path / "rigs" / "rig.yaml").write_text(text)
    source = read_rig_source(str(tmp_path / "rigs" / "rig.yaml"))
    assert [name for name, _ in source.files] == ["../camchain.yaml"]
    elsewhere = tmp_path / "worker"
    elsewhere.mkdir()
    rig = source.rig(elsewhere)
    assert (rig.folder / "../camchain.yaml").read_text() == kalibr
    assert elsewhere in (rig.folder / "../camchain.yaml").resolve().parents
    (tmp_path / "camchain.yaml").write_text(kalibr.replace("400.0, 400.0", "410.0, 410.0"))
    assert read_rig_source(source.url).sha256 != source.sha256
