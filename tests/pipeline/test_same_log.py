"""One recording in two encodings, and a stage at a time or all at once: the same numbers, to the last bit."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from ros2_twin import CELL, write_twins

from gtsam_rwhec.pipeline.all_stages import calibrate_log, export_solved, solve_into
from gtsam_rwhec.pipeline.cleaning_stage import clean_log
from gtsam_rwhec.pipeline.detection_stage import detect_log
from gtsam_rwhec.rig import read_rig


def numbers(out: Path) -> dict[str, Any]:
    """A result without what differs by chance (times) or by name (of the log)."""
    result: dict[str, Any] = json.loads((out / "result.json").read_text(encoding="utf-8"))
    for certificate in (result["certificate"], *(part["certificate"] for part in result["parts"])):
        certificate.pop("seconds", None)
    result["log"]["detection"].pop("sources")
    return result


@pytest.fixture(scope="module")
def twins(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with json.mcap and ros2.mcap: 16 images a camera."""
    folder = tmp_path_factory.mktemp("twins")
    write_twins(folder / "json.mcap", folder / "ros2.mcap", images=16)
    return folder


def test_ros2_bag_and_foxglove_json_and_stage_by_stage(twins: Path) -> None:
    rig = read_rig(CELL / "rig.yaml")
    calibrate_log(twins / "json.mcap", rig, twins / "from_json", workers=2)
    calibrate_log(twins / "ros2.mcap", rig, twins / "from_ros2", workers=1)
    assert numbers(twins / "from_json") == numbers(twins / "from_ros2")
    assert numbers(twins / "from_json")["certificate"]["status"] == "certified"

    detect_log(twins / "json.mcap", rig, twins / "detected.mcap")
    clean_log(twins / "detected.mcap", twins / "cleaned.mcap")
    solve_into(twins / "cleaned.mcap", None, twins / "by_stage")
    export_solved(twins / "by_stage" / "clean.mcap", twins / "by_stage")
    assert numbers(twins / "by_stage") == numbers(twins / "from_json")
    for path in (twins / "from_json").rglob("*"):
        if path.is_file() and path.suffix not in (".mcap", ".png", ".json"):
            assert path.read_bytes() == (twins / "by_stage" / path.relative_to(twins / "from_json")).read_bytes()

    # Taken up where a stage ended, and solved again in place: nothing of the solution before counts.
    calibrate_log(twins / "by_stage" / "clean.mcap", None, twins / "by_stage")
    assert numbers(twins / "by_stage") == numbers(twins / "from_json")
