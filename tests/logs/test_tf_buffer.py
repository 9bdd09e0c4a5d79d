"""Chains of transforms against their composition by hand, and the chains that there are not."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from log_files import TRANSFORM, header, ros2_log
from rwhec_factors import se3

from gtsam_rwhec.errors import TransformError
from gtsam_rwhec.logs import PoseRecord, TfBuffer, open_log


def record(parent: str, child: str, T: np.ndarray, stamp_ns: int = 0, topic: str = "/tf_static") -> PoseRecord:
    return PoseRecord(stamp_ns, stamp_ns, topic, parent, child, T)


def random_poses(seed: int, count: int) -> np.ndarray:
    return se3.expmap(np.random.default_rng(seed).normal(size=(count, 6)))


@given(seed=st.integers(0, 1000), ends=st.tuples(st.integers(0, 7), st.integers(0, 7)))
def test_a_tree_gives_what_its_frames_in_the_world_give(seed: int, ends: tuple[int, int]) -> None:
    rng = np.random.default_rng(seed)
    T_world = random_poses(seed, 8)
    buffer = TfBuffer()
    for i in range(1, 8):
        parent = int(rng.integers(i))
        buffer.add(record(f"f{parent}", f"f{i}", np.linalg.inv(T_world[parent]) @ T_world[i]))
    a, b = ends
    T, gap_s = buffer.at(f"f{a}", f"f{b}", np.array([5, 6]))
    np.testing.assert_allclose(T, np.broadcast_to(np.linalg.inv(T_world[a]) @ T_world[b], (2, 4, 4)), atol=1e-9)
    assert not gap_s.any()


def test_moving_links_are_interpolated() -> None:
    # A screw at constant rate: interpolation on SE(3) is exact.
    rate = np.array([0.1, 0.2, 0.3, 1.0, 2.0, 3.0])
    T_base = random_poses(1, 1)[0]
    T_tool = random_poses(2, 1)[0]
    moving = [record("base", "arm", T_base @ se3.expmap(rate[None] * s)[0], s * 10**9, "/tf") for s in (2, 0, 1, 1)]
    buffer = TfBuffer([*moving, record("arm", "tool", T_tool)])
    stamps = np.array([0, 250_000_000, 1_900_000_000, 2_000_000_000, 2_000_000_001, -1])
    T, gap_s = buffer.at("tool", "base", stamps)
    seconds = np.clip(stamps * 1e-9, 0, 2)
    expected = np.linalg.inv(T_base @ se3.expmap(rate * seconds[:, None]) @ T_tool)
    np.testing.assert_allclose(T, expected, atol=1e-12)
    assert gap_s.tolist() == [0, 1, 1, 0, np.inf, np.inf]


def test_the_last_of_equal_stamps_counts() -> None:
    poses = random_poses(3, 3)
    buffer = TfBuffer(record("a", "b", T, stamp, "/tf") for T, stamp in zip(poses, (5, 5, 7), strict=True))
    np.testing.assert_array_equal(buffer.at("a", "b", np.array([5]))[0][0], poses[1])


def test_from_a_log(tmp_path: Path) -> None:
    link = {"header": header(0, "base"), "child_frame_id": "hand", "transform": TRANSFORM}
    onward = {"header": header(0, "/hand"), "child_frame_id": "/cam", "transform": TRANSFORM}
    path = ros2_log(tmp_path / "a.mcap", [("/tf_static", "tf2_msgs/TFMessage", {"transforms": [link, onward]}, 0)])
    with open_log(path) as log:
        buffer = TfBuffer(log.records())
    T = log_T = buffer.at("base", "hand", np.array([0]))[0][0]
    np.testing.assert_allclose(buffer.at("base", "cam", np.array([0]))[0][0], T @ log_T, atol=1e-14)
    assert buffer.chain("cam", "base") == ("cam", "hand", "base")


def test_missing_links_and_loops_show_the_chain() -> None:
    eye = np.eye(4)
    buffer = TfBuffer([record("world", "arm", eye), record("arm", "hand", eye), record("rig", "cam", eye)])
    with pytest.raises(TransformError, match=re.escape("hand -> arm -> world ends there, and cam -> rig does")):
        buffer.at("hand", "cam", np.array([0]))
    with pytest.raises(TransformError, match="no frame tool; there are: arm, cam, hand, rig, world"):
        buffer.chain("tool", "cam")
    buffer.add(record("hand", "world", eye))
    with pytest.raises(TransformError, match="loop: arm -> world -> hand -> arm"):
        buffer.chain("arm", "cam")


@pytest.mark.parametrize(
    ("second", "words"),
    [
        (record("c", "b", np.eye(4)), "two parents, a .* and c"),
        (record("a", "b", np.eye(4), topic="/tf"), "static and moving"),
        (record("b", "b", np.eye(4)), "its own parent"),
        (record("a", "", np.eye(4)), "not a transform between two named frames"),
    ],
)
def test_contradictions(second: PoseRecord, words: str) -> None:
    buffer = TfBuffer([record("a", "b", np.eye(4))])
    with pytest.raises(TransformError, match=words):
        buffer.add(second)
