"""How the numbers of a folder's poses are meant, where files do not say it: every reading is solved for.

The order of quaternions and the convention of angles change the poses' rotations. A wrong one explains the images in
neither role; the right one explains them in one.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from gtsam_rwhec.cameras.targets import Target
from gtsam_rwhec.detect.detector import Detection
from gtsam_rwhec.first_rig.folder_contents import FolderPoses, ImageFolder, poses_read
from gtsam_rwhec.first_rig.roles import RoleEvidence, Seen, evidence_of_roles
from gtsam_rwhec.logs.pose_rows import PoseStatement

#: Conventions of three angles that arms' controllers and programs write, the commonest first.
AXES = ("ZYX", "xyz", "XYZ", "rotation_vector", "ZYZ", "zyx")
#: Poses are the same if their matrices differ by less than this.
SAME = 1e-6


@dataclass(frozen=True, eq=False)
class View:
    """A target in one image: the camera's number, the image's number in its folder, and the detection."""

    camera: int
    place: int
    sensor: str
    target: Target
    detection: Detection


@dataclass(frozen=True, eq=False)
class PoseReading:
    """How the poses are read.

    Attributes
    ----------
    stated : PoseStatement
        What the rig file must say.
    evidence : RoleEvidence
        Of the poses that are read so.
    otherwise : RoleEvidence or None
        Of the poses as they are read without a statement, where another reading explains the images far better.
    """

    stated: PoseStatement
    evidence: RoleEvidence
    otherwise: RoleEvidence | None


def best_reading(folder: Path, cameras: Sequence[ImageFolder], views: Sequence[View]) -> PoseReading:
    """The reading of the poses that explains the images; the usual one where no other is far better."""
    usual = [camera.poses for camera in cameras if camera.poses is not None]
    stated = usual[0].stated
    as_read = _evidence(usual, views)
    best, found = stated, as_read
    for other in _others(stated):
        read = [
            poses_read(folder, camera.files, folder / poses.path, other)
            for camera, poses in zip(cameras, usual, strict=True)
        ]
        there = [poses for poses in read if poses is not None]
        if len(there) < len(read) or all(_is_same(a, b) for a, b in zip(there, usual, strict=True)):
            continue
        evidence = _evidence(there, views)
        if evidence.explains_far_better(as_read) and (best is stated or evidence.is_better_than(found)):
            best, found = other, evidence
    return PoseReading(best, found, None if best is stated else as_read)


def _others(stated: PoseStatement) -> Iterator[PoseStatement]:
    if stated.euler is None:
        yield replace(stated, quaternion="wxyz")
        return
    for axes in AXES:
        yield replace(stated, euler=axes, angles="degrees")
        yield replace(stated, euler=axes, angles="radians")


def _is_same(first: FolderPoses, second: FolderPoses) -> bool:
    return bool(np.allclose(first.T, second.T, rtol=0.0, atol=SAME, equal_nan=True))


def _evidence(poses: Sequence[FolderPoses], views: Sequence[View]) -> RoleEvidence:
    return evidence_of_roles(
        Seen(view.sensor, view.target, view.detection, poses[view.camera].T[view.place]) for view in views
    )
