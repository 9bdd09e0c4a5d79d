"""One recording in two encodings, and a stage at a time or all at once: the same numbers, to the last bit."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import pytest
from ros2_twin import CELL, write_twins

from gtsam_rwhec.pipeline.all_stages import calibrate_log, export_solved, solve_into
from gtsam_rwhec.pipeline.cleaning_stage import clean_log
from gtsam_rwhec.pipeline.detection_stage import detect_log
from gtsam_rwhec.rig import parse_rig


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


@pytest.mark.parametrize(
    ("images", "offsets"), [(6, "stated"), pytest.param(16, "estimate", marks=pytest.mark.slow)], ids=["few", "more"]
)
def test_ros2_bag_and_foxglove_json_and_stage_by_stage(images: int, offsets: str, tmp_path: Path) -> None:
    """`images` of each camera, as json.mcap and ros2.mcap."""
    twins = tmp_path
    write_twins(twins / "json.mcap", twins / "ros2.mcap", images)
    rig = parse_rig(rig_text(offsets), "rig.yaml")
    calibrate_log(twins / "json.mcap", rig, twins / "from_json", workers=2)
    calibrate_log(twins / "ros2.mcap", rig, twins / "from_ros2", workers=1)
    assert numbers(twins / "from_json") == numbers(twins / "from_ros2")
    assert numbers(twins / "from_json")["certified"]["certificate"]["status"] == "certified"

    detect_log(twins / "json.mcap", rig, twins / "detected.mcap")
    clean_log(twins / "detected.mcap", twins / "cleaned.mcap")
    solve_into(twins / "cleaned.mcap", None, twins / "by_stage")
    export_solved(twins / "by_stage" / "clean.mcap", twins / "by_stage")
    assert numbers(twins / "by_stage") == numbers(twins / "from_json")
    for path in (twins / "from_json").rglob("*"):
        if path.is_file() and path.suffix not in (".mcap", ".png", ".json"):
            assert text_of(path) == text_of(twins / "by_stage" / path.relative_to(twins / "from_json"))

    # Taken up where a stage ended, and solved again in place: nothing of the solution before counts.
    calibrate_log(twins / "by_stage" / "clean.mcap", None, twins / "by_stage")
    assert numbers(twins / "by_stage") == numbers(twins / "from_json")
