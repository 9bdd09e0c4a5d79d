"""What a log says about its carriers: the role by solving both ways, rest or motion, the sizes of tags, the origin."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from places import CELL
from rwhec_factors import se3

from gtsam_rwhec.logs import DetectionRecord, LogWriter, open_log
from gtsam_rwhec.rig import Rig, parse_rig, propose_rig
from gtsam_rwhec.rig.target_sections import TagTarget

STEP_NS = 100_000_000


def proposed(path: Path) -> tuple[Rig, str, str]:
    with open_log(path) as log:
        text, notes = propose_rig(log, "rig.yaml")
    return parse_rig(text, "rig.yaml"), " ".join(text.replace("\n  #", "").split()), "\n".join(notes)


def written(path: Path, *, on_child: bool, parent: str = "base", child: str = "tool0", turning: bool = True) -> Path:
    """A log of poses at 10 Hz and of a driver's detections of a tag that is 8 cm where the driver says nothing."""
    rng = np.random.default_rng(7)
    X, Y = se3.expmap(rng.normal(size=(2, 6)))
    time = np.arange(60)[:, None]
    xi = 0.7 * np.sin(0.11 * time * np.array([1.0, 1.3, 0.7, 0.9, 1.1, 0.6]) + np.arange(6))
    if not turning:
        xi[:, :3] = 0.0
    T = se3.expmap(xi)
    B = se3.inverse(X) @ (se3.inverse(T) if on_child else T) @ Y @ se3.expmap(2e-3 * rng.normal(size=(60, 6)))
    B[:, :3, 3] *= 0.1 / 0.08  # lengths for a tag of 10 cm, which is what a first rig file says
    with LogWriter(path) as out:
        for i in range(60):
            out.transforms("/tf", 10**9 + i * STEP_NS, [(parent, child, T[i])])
            record = DetectionRecord(0, 0, "", "", "36h11", "5", T_camera_tag=B[i])
            out.detections("/tags", 10**9 + i * STEP_NS, "optical", [record])
    return path


@pytest.mark.parametrize("on_child", [True, False])
def test_the_role_and_the_size(tmp_path: Path, on_child: bool) -> None:
    rig, text, notes = proposed(written(tmp_path / "run.mcap", on_child=on_child))
    assert (rig.carriers.sensors, rig.carriers.targets) == (("tool0", "base") if on_child else ("base", "tool0"))
    assert "a guess: " + rig.carriers.sensors + " carries the sensors; solved both ways over 60 measurements" in text
    (tag,) = rig.targets.values()
    assert isinstance(tag, TagTarget)
    assert tag.size_m == pytest.approx(0.08, rel=0.01)
    assert "the length here is what the motion says" in text
    assert rig.carriers.noise is not None
    assert "a robot's arm, by the name tool0" in notes


def test_motion_that_tells_nothing(tmp_path: Path) -> None:
    rig, text, _ = proposed(written(tmp_path / "run.mcap", on_child=True, parent="a", child="b", turning=False))
    assert "TODO fixed camera and target on the hand: exchange the two names; solved both ways" in text
    assert rig.carriers.noise is None
    (tag,) = rig.targets.values()
    assert isinstance(tag, TagTarget)
    assert tag.size_m == 0.1


@pytest.mark.slow
def test_the_shipped_logs() -> None:
    rig, text, _ = proposed(CELL / "eye_to_hand.mcap")
    assert rig.carriers.sensors == "base"
    (tag,) = rig.targets.values()
    assert isinstance(tag, TagTarget)
    assert tag.size_m == pytest.approx(0.1, rel=0.01)
    rig, text, _ = proposed(CELL / "robot_cell.mcap")
    assert (rig.carriers.sensors, rig.carriers.targets) == ("hand", "base")
    assert {target.family for target in rig.target_list} == {"tag36h11", "aruco_5x5_50"}
    assert {sensor.time_offset for sensor in rig.sensors.values()} == {"estimate"}  # both logs are in motion
    assert text.count("the length here is what the motion says") >= 3
    assert "squares: [7, 5]" in text
    assert "other columns and rows do not fit" in text
