"""Samples of MoveIt, easy_handeye and OpenCV, written as these write them, give the same poses."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import sample_files
from hypothesis import given, settings
from hypothesis import strategies as st
from strategies import damaged

from gtsam_rwhec.errors import LogError
from gtsam_rwhec.logs.hand_eye_samples import read_hand_eye_samples

POSE = {"translation": {"x": 1, "y": 2, "z": 3}, "rotation": {"x": 0, "y": 0, "z": 0.6, "w": 0.8}}
WRITERS = {
    "moveit.yaml": sample_files.moveit,
    "take_sample.yaml": sample_files.easy_handeye,
    "stamped.json": sample_files.easy_handeye_stamped,
    "arrays.yaml": sample_files.opencv,
    "arrays.xml": sample_files.opencv,
    "arrays.json": sample_files.opencv,
    "lists.json": sample_files.opencv_lists,
}


@pytest.mark.parametrize("name", sorted(WRITERS))
def test_each_tool_gives_the_same_poses(tmp_path: Path, name: str) -> None:
    hands, B, _, _ = sample_files.rig_poses(on_hand=True, count=3)
    found = read_hand_eye_samples(WRITERS[name](tmp_path / name, hands, B))
    np.testing.assert_allclose(found.T_base_hand(True), hands, atol=1e-12)
    np.testing.assert_allclose(found.B, B, atol=1e-12)
    assert found.is_on_hand is None


@pytest.mark.parametrize("on_hand", [True, False])
def test_easy_handeye2_looks_the_robot_up_the_other_way_for_a_fixed_camera(tmp_path: Path, on_hand: bool) -> None:
    hands, B, _, _ = sample_files.rig_poses(on_hand, count=3)
    word = "eye_in_hand" if on_hand else "eye_on_base"
    found = read_hand_eye_samples(sample_files.easy_handeye2(tmp_path / "cell.samples", hands, B, word))
    assert found.is_on_hand is on_hand
    np.testing.assert_allclose(found.T_base_hand(on_hand), hands, atol=1e-12)
    np.testing.assert_allclose(found.A(on_hand), np.linalg.inv(hands) if on_hand else hands, atol=1e-12)
    words = "T_base_hand" if on_hand else "T_hand_base"
    assert f"the robot's poses were read as {words}, the target's as T_camera_target" in found.reading(on_hand)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("a: [1, 2]", "has no hand-eye samples. Samples have, with names of MoveIt: effector_wrt_world and object"),
        ("- {effector_wrt_world: [1], object_wrt_sensor: [1]}", r"line 1: \[0\].effector_wrt_world: .* is no pose"),
        ("- {effector_wrt_world: [1], object_wrt_sensor: [1]}\n- {effector_wrt_world: [1]}", r"line 2: \[1\]: no obj"),
        ("samples:\n- {robot: 1}\n- {robot: 1, tracking: 2}", r"line 2: samples\[0\]: no tracking; a sample of easy"),
        ("samples: {hand_world_samples: [], camera_marker_samples: []}", "0 poses of the robot .* and 0 of the target"),
        ("samples: {hand_world_samples: 1, camera_marker_samples: []}", "hand_world_samples: 1; a list of poses"),
    ],
)
def test_what_is_no_sample(tmp_path: Path, text: str, words: str) -> None:
    (tmp_path / "a.yaml").write_text(text)
    with pytest.raises(LogError, match=words) as caught:
        read_hand_eye_samples(tmp_path / "a.yaml")
    assert "a.yaml" in str(caught.value)


def test_millimetres_and_norms_are_found_when_samples_are_read(tmp_path: Path) -> None:
    hands, B, _, _ = sample_files.rig_poses(on_hand=True, count=4)
    for T in (hands, B):
        in_mm = T.copy()
        in_mm[:, :3, 3] *= 1e3
        given = (in_mm, B) if T is hands else (hands, in_mm)
        for name, write in WRITERS.items():
            with pytest.raises(LogError, match="Are they millimetres"):
                read_hand_eye_samples(write(tmp_path / name, *given))
    text = sample_files.easy_handeye(tmp_path / "a.yaml", hands, B).read_text()
    (tmp_path / "a.yaml").write_text(text.replace("w: 0", "w: 1", 1))
    with pytest.raises(LogError, match=r"a\.yaml, line \d+: samples.hand_world_samples\[0\]: quaternion .* has norm"):
        read_hand_eye_samples(tmp_path / "a.yaml")


@settings(max_examples=100, deadline=None)
@given(
    text=st.text(alphabet="[]{}:,- \n1.e-x", max_size=60).map(
        lambda part: f"- {{effector_wrt_world: {part}, object_wrt_sensor: [1]}}\n"
    )
    | damaged([json.dumps({"samples": [{"robot": POSE, "tracking": POSE}] * 2}).encode()]).map(
        lambda content: content.decode(errors="replace")
    )
    | damaged([b'{"R_gripper2base": [[1,0,0,0,1,0,0,0,1]], "t_gripper2base": [[1,2,3]], "rvec_target2cam": [[1,2,3]], '
               b'"tvec_target2cam": [[1,2,3]]}']).map(lambda content: content.decode(errors="replace"))
)  # fmt: skip
def test_any_file_gives_samples_or_an_error_of_ours(tmp_path_factory: pytest.TempPathFactory, text: str) -> None:
    path = tmp_path_factory.getbasetemp() / "any_samples.yaml"
    path.write_text(text)
    try:
        found = read_hand_eye_samples(path)
    except LogError as error:
        assert path.name in str(error)  # noqa: PT017
        assert len(str(error)) < 2000  # noqa: PT017
    else:
        assert np.isfinite(found.robot).all()
        assert np.isfinite(found.B).all()
