"""One recording in two encodings, and a stage at a time or all at once: the same numbers, to the last bit."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import pytest
from ros2_twin import CELL, write_twins

from gtsam_rwhec.rig import Rig, parse_rig
from gtsam_rwhec.runs.cleaning_stage import clean_log
from gtsam_rwhec.runs.detection_stage import detect_log
from gtsam_rwhec.runs.whole_runs import calibrate_log, export_solved, solve_into


def text_of(path: Path) -> str:
    """A file's text without the name of the file that holds the rig."""
    return re.sub(r"\([^()]*: (targets|sensors)\.", r"(FILE: \1.", path.read_text(encoding="utf-8"))


def numbers(out: Path) -> dict[str, Any]:
    """A result without what differs by chance (times) or by name (of the log, and of the file that holds the rig)."""
    result: dict[str, Any] = json.loads(text_of(out / "result.json"))
    certified = result["certified"]
    for certificate in (certified["certificate"], *(part["certificate"] for part in certified["parts"])):
        certificate.pop("seconds", None)
    result["log"]["detection"].pop("sources")
    return result


def rig_text(offsets: str) -> str:
    """The shipped rig file; clocks' offsets stated, as few images do not tell them, or estimated."""
    text = (CELL / "rig.yaml").read_text(encoding="utf-8")
    if offsets == "estimate":
        return text
    left, wide = text.split("  cam_wide:")
    return left.replace("estimate", "0.0", 1) + "  cam_wide:" + wide.replace("estimate", "0.035", 1)


def by_stage(raw: Path, rig: Rig, out: Path) -> None:
    """Each stage by itself."""
    detect_log(raw, rig, out / "detected.mcap")
    clean_log(out / "detected.mcap", out / "cleaned.mcap")
    solve_into(out / "cleaned.mcap", None, out)


def check_files(out: Path, expected: Path) -> None:
    """The text files for other programs are the same."""
    for path in expected.rglob("*"):
        if path.is_file() and path.suffix not in (".mcap", ".png", ".json", ".html"):
            assert text_of(path) == text_of(out / path.relative_to(expected))


@pytest.mark.slow
def test_foxglove_json_at_once_and_a_ros2_bag_stage_by_stage(tmp_path: Path) -> None:
    """Six images of each camera."""
    write_twins(tmp_path / "json.mcap", tmp_path / "ros2.mcap", 6)
    rig, out = parse_rig(rig_text("stated"), "rig.yaml"), tmp_path / "by_stage"
    calibrate_log(tmp_path / "json.mcap", rig, tmp_path / "from_json", workers=2)
    out.mkdir()
    by_stage(tmp_path / "ros2.mcap", rig, out)
    export_solved(out / "calibration.mcap", out)
    assert numbers(out) == numbers(tmp_path / "from_json")
    assert numbers(out)["certified"]["certificate"]["status"] == "certified"
    check_files(out, tmp_path / "from_json")
    # Solved again in place: nothing of the solution before counts.
    solve_into(out / "calibration.mcap", None, out)
    assert numbers(out) == numbers(tmp_path / "from_json")


@pytest.mark.slow
def test_each_encoding_at_once_and_stage_by_stage_with_estimated_clocks(tmp_path: Path) -> None:
    """Sixteen images of each camera, each way by itself; and a whole calibration taken up where a stage ended."""
    write_twins(tmp_path / "json.mcap", tmp_path / "ros2.mcap", 16)
    rig, out = parse_rig(rig_text("estimate"), "rig.yaml"), tmp_path / "by_stage"
    calibrate_log(tmp_path / "json.mcap", rig, tmp_path / "from_json", workers=2)
    calibrate_log(tmp_path / "ros2.mcap", rig, tmp_path / "from_ros2", workers=1)
    assert numbers(tmp_path / "from_json") == numbers(tmp_path / "from_ros2")
    assert numbers(tmp_path / "from_json")["certified"]["certificate"]["status"] == "certified"
    out.mkdir()
    by_stage(tmp_path / "json.mcap", rig, out)
    export_solved(out / "calibration.mcap", out)
    assert numbers(out) == numbers(tmp_path / "from_json")
    check_files(out, tmp_path / "from_json")
    calibrate_log(out / "calibration.mcap", None, out)
    assert numbers(out) == numbers(tmp_path / "from_json")
