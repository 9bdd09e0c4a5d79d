"""What a pair of names is."""

from __future__ import annotations

import pickle

from gtsam_rwhec.problem.measurements import Pair


def test_a_pair_is_a_tuple_and_found_as_one() -> None:
    pair = Pair("tag_0", "cam_0")
    assert pair == ("tag_0", "cam_0")
    assert {pair: 1}["tag_0", "cam_0"] == 1
    assert pickle.loads(pickle.dumps(pair)).label == "tag_0-cam_0"


def test_its_label_is_how_it_is_written() -> None:
    assert f"{Pair('tag_0', 'cam_0')}" == Pair("tag_0", "cam_0").label == "tag_0-cam_0"
    assert str(Pair("cam_0", "cam_0")) == "the motions of cam_0"


def test_motions_have_one_frame() -> None:
    motions, seen = Pair("cam_0", "cam_0"), Pair("tag_0", "cam_0")
    assert motions.is_motion
    assert not seen.is_motion
    assert motions.frames == ("cam_0",)
    assert seen.frames == ("tag_0", "cam_0")
