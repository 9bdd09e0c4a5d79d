"""A hand with cameras that see tags, and sensors on it that know only their own motion: one calibration of all."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import synthetic_logs as made
from rwhec_factors import se3

import gtsam_rwhec as rw
from gtsam_rwhec.errors import LogError
from gtsam_rwhec.logs import open_log
from gtsam_rwhec.problem.measurements import Pair
from gtsam_rwhec.runs import clean_log, detect_log, read_solved
from gtsam_rwhec.runs.measured_pairs import read_pairs
from gtsam_rwhec.runs.solving_stage import Solved
from gtsam_rwhec.simulate import frame_distance

pytestmark = pytest.mark.usefixtures("without_figures")

SECONDS = 10.0
#: T_hand_sensor, and of the second the measured over the true length.
MOUNTS = {"tracker": made.pose((30, -50, 100), (0.1, -0.2, 0.15)), "vo": made.pose((-100, 10, 60), (-0.1, 0.05, 0.2))}
SCALE, OFFSET_S = 0.4, 0.12
RIG = made.rig_text().replace(
    "  cam_1:\n    detections: /cam_1/tags\n",
    "  tracker:\n    odometry: {topic: /tracker/odom}\n    time_offset: estimate\n"
    "  vo:\n    odometry: {topic: /vo/odom, scale: estimate}\n",
)


def odometry(name: str, rng: np.random.Generator, *, scale: float = 1.0, offset_s: float = 0.0) -> list[made.Message]:
    """Poses at 25 Hz from a starting frame, with errors that add up: 0.05 degrees and 0.5 mm after a second."""
    times = np.arange(0.0, SECONDS, 0.04)
    T = np.array([made.hand(t) for t in times]) @ MOUNTS[name]
    steps = se3.inverse(T[:-1]) @ T[1:]
    spread = np.r_[np.full(3, np.radians(0.05)), np.full(3, 5e-4)] * np.sqrt(0.04)
    steps = steps @ se3.expmap(rng.normal(size=(len(steps), 6)) * spread)
    steps[:, :3, 3] *= scale
    pose, found = np.eye(4), [np.eye(4)]
    for step in steps:
        pose = pose @ step
        found.append(pose)
    stamps = [made.BEGIN_NS + round(1e9 * (t - offset_s)) for t in times]
    return [
        made.transform(stamp, f"{name}_start", name, one, f"/{name}/odom")
        for stamp, one in zip(stamps, found, strict=True)
    ]


def messages() -> list[made.Message]:
    rng = np.random.default_rng(3)
    seen = [one for one in made.recording(SECONDS, camera_hz=2.0) if one.topic != "/cam_1/tags"]
    moved = odometry("tracker", rng, offset_s=OFFSET_S) + odometry("vo", rng, scale=SCALE)
    return sorted(seen + moved, key=lambda message: message.logged_ns)


def check(calibrated: Solved) -> None:
    refined = calibrated.refined
    assert calibrated.judgement.verdict is not rw.Verdict.DO_NOT_USE, str(calibrated.judgement)
    assert calibrated.solution.certificate.status.value == "certified"
    for name, truth in ({"cam_0": made.Y["cam_0"]} | MOUNTS).items():
        assert refined.contains(name, truth, 0.9999), name
        off = frame_distance(refined.Y[name].matrix(), truth)
        assert off.translation_mm < 5.0, name
        assert off.rotation_deg < 0.2, name
    assert isinstance(refined.scale, dict)
    assert refined.scale["vo"] == pytest.approx(SCALE, rel=0.02)
    assert refined.scale["tracker"] == 1.0
    offsets = {one.sensor: one for one in calibrated.log.time_offsets}
    assert offsets["tracker"].sigma_s is not None
    assert abs(offsets["tracker"].offset_s - OFFSET_S) < 4.0 * offsets["tracker"].sigma_s
    counts = {(count.target, count.sensor): count for count in calibrated.log.cleaning.tracks}
    assert counts["vo", "vo"].used > 10


def test_cameras_and_odometries_are_one_problem(tmp_path: Path) -> None:
    calibrated = made.solved(tmp_path, messages(), RIG)
    check(calibrated)
    # a jump of a tracker that lost its way is left out, with its reason
    jumped = [
        replace(one, content=_moved(one.content)) if one.topic == "/vo/odom" and one.logged_ns > MIDDLE_NS else one
        for one in messages()
    ]
    log = made.write(tmp_path / "jumped.mcap", jumped)
    rig = rw.rig.parse_rig(RIG.replace("scale: estimate", "max_turn_deg_s: 300"), "rig.yaml")
    detect_log(log, rig, tmp_path / "detected.mcap")
    (count,) = (
        one for one in clean_log(tmp_path / "detected.mcap", tmp_path / "calibration.mcap").tracks if one.target == "vo"
    )
    assert count.removed == {"step of the odometry that nothing drives (lost tracking)": 1}
    with open_log(tmp_path / "calibration.mcap") as cleaned:
        pairs = read_pairs(cleaned, rig)
    assert pairs[Pair("vo", "vo")].count == count


def test_targets_that_alone_have_no_answer_are_said(tmp_path: Path) -> None:
    """Their weights beside the motions' are then guessed."""
    seen = [one for one in messages() if one.topic == "/cam_0/tags"]
    one_tag = [replace(one, content={**one.content, "detections": one.content["detections"][:1]}) for one in seen[:2]]
    few = [*(one for one in messages() if one.topic != "/cam_0/tags"), *one_tag]
    solved = made.solved(tmp_path, few, RIG)
    words = [one.words for one in solved.calibration.findings if one.ground is rw.Ground.NOT_CHECKED]
    assert any(one.startswith("the noise of the targets' poses beside that of the motions is guessed") for one in words)
    assert solved.judgement.verdict is not rw.Verdict.USE


#: Here an odometry jumps by 5 m.
MIDDLE_NS = made.BEGIN_NS + 5_000_000_000


def _moved(content: Mapping[str, Any]) -> dict[str, Any]:
    (part,) = content["transforms"]
    place = part["translation"]
    return {"transforms": [part | {"translation": place | {"x": place["x"] + 5.0}}]}


@pytest.mark.slow
def test_an_odometry_of_another_time_is_named_with_its_line(tmp_path: Path) -> None:
    later = [one.stamped(one.stamp_ns + 10**12) if one.topic == "/vo/odom" else one for one in messages()]
    with pytest.raises(LogError, match=r"rig.yaml, line 12: sensors.vo: topic /vo/odom has 0 windows .*of one clock"):
        made.solved(tmp_path, later, RIG)


@pytest.mark.slow
def test_the_whole_road_writes_all_files(tmp_path: Path) -> None:
    log = made.write(tmp_path / "raw.mcap", messages())
    rig = rw.rig.parse_rig(RIG, "rig.yaml")
    check(rw.calibrate_log(log, rig, tmp_path / "out"))
    assert "tracker" in (tmp_path / "out" / "rig.urdf.xacro").read_text(encoding="utf-8")
    assert (tmp_path / "out" / "report.html").exists()
    assert set(rw.read_solution(tmp_path / "out" / "result.json").Y) == {"cam_0", "tracker", "vo"}
    check(read_solved(tmp_path / "out" / "calibration.mcap"))
