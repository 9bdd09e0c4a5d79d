"""Which stages a changed rig file asks for again."""

from __future__ import annotations

import pytest

from gtsam_rwhec.rig import parse_rig
from gtsam_rwhec.runs.changed_rig import changes

RIG = """\
carriers: {sensors: hand, targets: base, poses: {tf: [base, hand]}}
sensors: {cam: {images: /image, intrinsics: {file: camera.yaml, stated: nominal}}}
targets: {tag: {type: tag, family: tag36h11, id: 3, size_m: 0.1}}
"""


@pytest.mark.parametrize(
    ("right", "other", "detection", "cleaning"),
    [
        ("nominal", "calibration", (), ()),  # refinement alone asks it
        ("file: camera.yaml", "file: other.yaml", ("sensors.cam.intrinsics",), ()),
        ("size_m: 0.1", "size_m: 0.2", ("targets.tag",), ()),
        ("tf: [base, hand]", "tf: [hand, base]", (), ("carriers.poses",)),
    ],
)
def test_keys_ask_for_their_stage(
    right: str, other: str, detection: tuple[str, ...], cleaning: tuple[str, ...]
) -> None:
    assert right in RIG
    found = changes(parse_rig(RIG, "rig.yaml"), parse_rig(RIG.replace(right, other), "rig.yaml"))
    assert (found.detection, found.cleaning) == (detection, cleaning)
