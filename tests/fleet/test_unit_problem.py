"""Rig files and cameras that contradict each other within a robot or on a site are named, both places with them."""

from __future__ import annotations

import pytest
from fleets import rig_text

import gtsam_rwhec as rw
from gtsam_rwhec.fleet.unit_problem import check_rigs
from gtsam_rwhec.rig import Rig, parse_rig

CAMS = ["cam_0"]


def rig(text: str = "", **changed: float) -> Rig:
    return parse_rig(text or rig_text(CAMS, 2, **changed), "rig.yaml")  # type: ignore[arg-type]


def test_those_that_agree() -> None:
    more = rig(rig_text(["cam_0", "cam_1"], 3))
    check_rigs({"a": [("a.yaml", rig()), ("b.yaml", more)], "b": [("c.yaml", rig())]})


def test_a_targets_size() -> None:
    with pytest.raises(rw.errors.RigError, match=r"target tag_0 differs between a\.yaml and b\.yaml \(size_m: 0\.12 "):
        check_rigs({"a": [("a.yaml", rig())], "b": [("b.yaml", rig(size_m=0.1))]})


def test_a_cameras_intrinsics_within_a_robot_but_not_on_a_site() -> None:
    other = rig(focal=500.0)
    with pytest.raises(rw.errors.RigError, match=r"sensor cam_0 has other intrinsics in b\.yaml than in a\.yaml"):
        check_rigs({"a": [("a.yaml", rig()), ("b.yaml", other)]})
    check_rigs({"a": [("a.yaml", rig())], "b": [("b.yaml", other)]})


def test_the_carrier_of_targets_and_how_sizes_are_taken() -> None:
    text = rig_text(CAMS, 2).replace("base", "floor").replace("sizes: known", "sizes: estimate")
    with pytest.raises(rw.errors.RigError) as caught:
        check_rigs({"a": [("a.yaml", rig())], "b": [("s3://user:word@store/b.yaml", rig(text))]})
    assert "is base in a.yaml and floor in s3://store/b.yaml" in str(caught.value)
    assert "sizes is known in a.yaml and estimate in" in str(caught.value)
    assert "word" not in str(caught.value)
