"""A log of which a sensor or a target of the rig file has no answer: it is named, and the others are given."""

from __future__ import annotations

import ast
import dataclasses
from collections.abc import Collection, Iterable
from pathlib import Path

import pytest
import synthetic_logs as made
import yaml
from given_commands import given

import gtsam_rwhec as rw
from gtsam_rwhec.calibration.verdict import Ground
from gtsam_rwhec.cli.failures import exit_status
from gtsam_rwhec.simulate import frame_distance

pytestmark = pytest.mark.usefixtures("without_figures")

FILES = set(rw.rig.FILES)


def seen(
    messages: Iterable[made.Message], camera: str, tags: Collection[int], images: Collection[int] | None = None
) -> list[made.Message]:
    """The messages, where a camera sees these tags only, in these of its images only."""
    result, number = [], 0
    for message in messages:
        if message.topic == f"/{camera}/tags":
            parts = [part for part in message.content["detections"] if int(part["id"]) in tags]
            is_seen = images is None or number in images
            message = dataclasses.replace(message, content=message.content | {"detections": parts if is_seen else []})
            number += 1
        result.append(message)
    return result


def words(text: str) -> str:
    return " ".join(text.split())


def test_one_that_nothing_was_seen_of_is_named_and_files_are_written_only_on_request(tmp_path: Path) -> None:
    """A camera with a clock to be estimated saw nothing, and no camera saw a tag."""
    log = made.write(tmp_path / "raw.mcap", seen(seen(made.recording(6.0), "cam_0", (0, 1)), "cam_1", ()))
    rig = tmp_path / "rig.yaml"
    rig.write_text(made.rig_text(cam_1="detections: /cam_1/tags\n    time_offset: estimate"), encoding="utf-8")
    out = tmp_path / "out"
    done = given("calibrate", log, "--rig", rig, "-o", out, "--anyway")
    assert done.exit_code == 6, done.stderr
    needed = "at least 3 poses with two turning axes are needed"
    for said in (
        f"cam_1: 0 measurements (its 29 images show no target), {needed}",
        f"tag_2: 0 measurements (no sensor saw it), {needed}",
    ):
        assert said in words(done.stdout)
        for name in FILES:  # as a comment in the head
            text = (out / name).read_text(encoding="utf-8")
            assert f"Left out, because it has no answer: {said}" in words(text)
            assert words(text[:200]).count("Do not use these poses: cam_1: 0 measurements") == 1
    assert f"marked so in the head: {', '.join(rw.rig.FILES)}" in words(done.stderr)
    result = rw.results.read_result(out / "result.json")
    assert result.refined is not None
    assert set(result.refined.Y) == {"cam_0"}
    assert set(result.refined.X) == {"tag_0", "tag_1"}
    assert frame_distance(result.refined.Y["cam_0"].matrix(), made.Y["cam_0"]).translation_mm < 3.0
    ast.parse((out / "static_tf.launch.py").read_text(encoding="utf-8"))
    frames = yaml.safe_load((out / "tf.yaml").read_text(encoding="utf-8"))["transforms"]
    assert {frame["child_frame_id"] for frame in frames} == {"cam_0", "tag_0", "tag_1"}

    again = given("export", out / "calibration.mcap", "-o", out)
    assert again.exit_code == 6
    assert not FILES & {path.name for path in out.iterdir()}  # those of before are not left as if they were of now
    assert "Not written, as the poses are not to be used: static_tf.launch.py" in words(again.stderr)


@pytest.mark.parametrize(
    ("messages", "ground", "said", "status"),
    [
        (
            seen(made.recording(6.0), "cam_1", (0, 1, 2), (4, 20)),
            Ground.NO_ANSWER,
            "cam_1: 6 measurements at 2 poses",
            6,
        ),
        (
            seen(seen(made.recording(6.0), "cam_0", (0, 1)), "cam_1", (2,), (4, 20)),
            Ground.NOT_UNIQUE,
            "cam_1: 2 measurements at 2 poses (of 2 detections in 29 images), at least 3 poses",
            3,
        ),
    ],
    ids=["its targets are known from another camera", "and a target of its own"],
)
def test_a_sensor_with_few_measurements(
    messages: list[made.Message], ground: Ground, said: str, status: int, tmp_path: Path
) -> None:
    judgement = made.solved(tmp_path, messages, made.RIG).judgement
    assert judgement.verdict is rw.Verdict.DO_NOT_USE
    assert judgement.grounds[0] is ground
    assert said in str(judgement)
    assert exit_status(judgement, of_rig=True) == status


@pytest.mark.parametrize(
    ("grounds", "status"),
    [((), 0), ((Ground.SYSTEMATIC,), 0), ((Ground.FEW_MEASUREMENTS,), 3), ((Ground.TARGET_CONTRADICTED,), 6)],
    ids=str,
)
def test_a_target_whose_pose_is_not_to_be_used_is_no_success_of_its_rig_file(
    grounds: tuple[Ground, ...], status: int
) -> None:
    verdict = rw.Verdict.CARE if grounds else rw.Verdict.USE
    judgement = rw.Judgement(verdict, grounds, "")
    assert exit_status(judgement, of_rig=True) == status
    assert exit_status(judgement) == 0
