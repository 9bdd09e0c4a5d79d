"""The sections of numbers: verdict, who determines whom, proof, uncertainty, inputs; of results of all kinds."""

from __future__ import annotations

import json
from pathlib import Path

import gtsam
import numpy as np
import pytest
from places import REPOSITORY
from refinement_problems import rig
from shown_numbers import numbers_of, wrong_numbers

import gtsam_rwhec as rw
from gtsam_rwhec.report.page import Block, CopyText, Section, ShownResult, Table
from gtsam_rwhec.report.page.sections import sections_of
from gtsam_rwhec.report.page.written import read_shown

GOLDEN = REPOSITORY / "tests" / "golden"


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A calibration of a small rig from a program: result, evidence and report."""
    folder = tmp_path_factory.mktemp("numbers")
    problem = rig(targets=2, sensors=2).problem
    calibration = rw.calibrate(problem, rw.CalibrateOptions(sizes="known"))
    rw.write_calibration(calibration, folder / "result.json")
    rw.evidence.write_evidence(rw.evidence.evidence_of(problem, calibration), folder / "evidence.json")
    rw.report.write_html(folder, folder / "report.html")
    return folder


def section(shown: ShownResult, name: str) -> Section:
    return next(each for each in sections_of(shown) if each.name == name)


def tables(blocks: tuple[Block, ...]) -> dict[str, Table]:
    return {block.caption: block for block in blocks if isinstance(block, Table)}


def texts(blocks: tuple[Block, ...]) -> dict[str, str]:
    return {block.name: block.text for block in blocks if isinstance(block, CopyText)}


def test_every_number_is_that_of_the_json(folder: Path) -> None:
    page = (folder / "report.html").read_text(encoding="utf-8")
    files = {name: json.loads((folder / name).read_text(encoding="utf-8")) for name in ("result.json", "evidence.json")}
    assert len(numbers_of(page)) > 50
    assert list(wrong_numbers(page, files)) == []


def test_poses_are_shown_in_metres_and_degrees(folder: Path) -> None:
    shown = read_shown(folder)
    assert shown.result is not None
    (of_sensors,) = (
        table for title, table in tables(section(shown, "verdict").blocks).items() if title.startswith("Sensors")
    )
    assert of_sensors.headings[:7] == ("sensor", "x m", "y m", "z m", "roll°", "pitch°", "yaw°")
    assert shown.result.refined is not None
    for name, *cells in of_sensors.rows:
        pose = shown.result.refined.Y[str(name)]
        written = [float(cell.text) for cell in cells[:6]]  # type: ignore[union-attr]
        assert written[:3] == pytest.approx(pose.translation(), abs=6e-5)
        assert written[3:] == pytest.approx(np.degrees(pose.rotation().rpy()), abs=6e-3)


def test_without_evidence_poses_have_quaternions_and_inputs_say_why(folder: Path) -> None:
    shown = ShownResult.of((folder / "result.json").read_bytes(), None)
    (heading,) = {
        table.headings[4:8]
        for title, table in tables(section(shown, "verdict").blocks).items()
        if "in the frame" in title
    }
    assert heading == ("qw", "qx", "qy", "qz")
    assert any("no evidence.json" in str(block) for block in section(shown, "inputs").blocks)


def test_copied_python_is_the_pose_to_the_last_bit(folder: Path) -> None:
    shown = read_shown(folder)
    assert shown.result is not None
    assert shown.result.refined is not None
    found: dict[str, dict[tuple[str, str], np.ndarray]] = {}
    exec(texts(section(shown, "inputs").blocks)["poses"], found)
    for name, pose in shown.result.refined.Y.items():
        assert gtsam.Pose3(found["POSES"]["sensorcarrier", name]).equals(pose, 0.0)


def test_copied_texts_of_poses_that_are_not_to_be_used_say_so(folder: Path) -> None:
    tree = json.loads((GOLDEN / "result_version_7.json").read_bytes())
    shown = ShownResult(tree | {"verdict": "do_not_use", "verdict_reason": "they are\nmade up"}, None, None, "x")
    from_file = ShownResult.of((GOLDEN / "result_version_7.json").read_bytes(), None)
    texts_of = texts(section(ShownResult(shown.tree, from_file.result, None, "x"), "inputs").blocks)
    assert len(texts_of) == 4
    for text in texts_of.values():
        head = text[:200]
        assert "Do not use these poses: they are" in head
        assert "\nmade up" not in head


def test_options_that_are_not_the_default_and_seeds_are_shown(folder: Path) -> None:
    found = tables(section(read_shown(folder), "inputs").blocks)
    assert found["Options that are not the default"].rows == (("sizes", "'known'"),)
    assert "Seeds of random numbers" in found


@pytest.mark.parametrize("name", sorted(path.stem for path in GOLDEN.glob("result_version_*.json")))
def test_results_of_all_versions_have_all_sections(name: str) -> None:
    shown = read_shown(GOLDEN / f"{name}.json")
    assert len(sections_of(shown)) == len({each.name for each in sections_of(shown)})
    for each in sections_of(shown):
        assert each.blocks or each.missing
    assert any("in the frame" in title for title in tables(section(shown, "verdict").blocks))


def test_a_calibration_without_an_answer_is_shown() -> None:
    tree = {
        "format": "gtsam-rwhec result",
        "format_version": 7,
        "written_by": "gtsam-rwhec 0.1.0",
        "verdict": "do_not_use",
        "verdict_reason": "there is no answer with a positive scale. What to do: look at A",
        "verdict_grounds": ["no_scale"],
        "sensors": [],
        "targets": [],
        "conventions": {},
        "calibration": {"findings": [], "choices": [], "points": [], "noise": "", "outliers": "", "notes": []},
    }
    shown = ShownResult.of(json.dumps(tree).encode(), None)
    assert "Look at A." in str(section(shown, "verdict"))
    for each in sections_of(shown):
        assert each.blocks or each.missing


def test_a_file_that_is_no_result_is_refused() -> None:
    for content in (b"{", b"[]", b'{"verdict": "do_not_use", "verdict_reason": "x"}'):
        with pytest.raises(rw.errors.FileFormatError, match="is not a result"):
            ShownResult.of(content, None)
