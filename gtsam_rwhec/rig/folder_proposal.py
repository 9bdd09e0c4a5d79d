"""A first rig file, proposed from the content of a folder of images; TODO marks the values that a person must state."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from gtsam_rwhec.cameras.camera import Camera
from gtsam_rwhec.cameras.targets import Target
from gtsam_rwhec.detect.detections import Detection
from gtsam_rwhec.detect.detector import Detector
from gtsam_rwhec.errors import RigError
from gtsam_rwhec.files.progress import Progress, silent
from gtsam_rwhec.files.terminal_text import some
from gtsam_rwhec.geometry.trajectory import Trajectory
from gtsam_rwhec.logs.image_folder import pose_stamps
from gtsam_rwhec.logs.pose_tables import PoseStatement
from gtsam_rwhec.rig.carrier_roles import (
    Rest,
    RoleEvidence,
    Seen,
    evidence_of_roles,
    first_time_offset,
    origin_of,
    rest_of,
)
from gtsam_rwhec.rig.folder_contents import FolderPoses, ImageFolder, cloud_folders, poses_read, read_folder, read_gray
from gtsam_rwhec.rig.guessed_boards import STATED, guessed_intrinsics
from gtsam_rwhec.rig.guessed_targets import first_targets, take_sizes
from gtsam_rwhec.rig.log_contents import ImageTopic, camera_name, free_name
from gtsam_rwhec.rig.rig import Rig
from gtsam_rwhec.rig.rig_file import first_rig_text, parse_rig
from gtsam_rwhec.rig.section_types import is_text
from gtsam_rwhec.rig.sections import Carriers, Intrinsics, PoseSource, Sensor

#: At most this number of images of each folder, spread evenly, is searched for targets and used to solve for roles.
IMAGES = 16
#: Names for the frames of a folder's poses; files do not name them.
PARENT, CHILD = "base", "hand"

#: What the evidence says of the carriers, by the role that it finds.
ROLES = {
    "child": f"the cameras are on {CHILD}",
    "parent": f"the cameras are on {PARENT}, and the targets on {CHILD}",
    None: "the data cannot tell",
}


def propose_folder_rig(
    folder: str | Path, path: str | Path, *, progress: Progress | None = None
) -> tuple[str, tuple[str, ...]]:
    """Propose a rig file for folders of images, or of clouds, with poses beside them; a person completes it.

    Paths in the rig file start from `folder`; `path` is the file that will be written, for messages. Returns the text
    of a rig file that `parse_rig` reads, and notes: what was seen, what was chosen, and what was left out.

    Raises
    ------
    RigError
        There are no images, or no poses that fit them; the message says what was looked at.
    """
    folder, tell = Path(folder), progress or silent
    notes: list[str] = []
    of_clouds = cloud_folders(folder)
    if of_clouds and not read_folder(folder):
        from gtsam_rwhec.rig.cloud_proposal import propose_cloud_rig  # needs an extra that images do without

        proposal = propose_cloud_rig(folder, of_clouds, tell)
        parse_rig(proposal.text, str(path))
        return proposal.text, proposal.notes
    notes += [f"not used: {each.path}, {len(each.files)} clouds beside images" for each in of_clouds]
    cameras = _cameras(folder, notes)
    topics = []
    for camera, _ in cameras:
        tell(f"searching {camera.path}")
        topic = ImageTopic(camera.path, "", len(camera.files))
        for i in np.unique(np.linspace(0, len(camera.files) - 1, IMAGES).round().astype(int)):
            gray = read_gray(camera.files[i])
            if gray is not None and gray.shape[::-1] == camera.size:
                topic.search(gray, int(i))
        topics.append(topic)
    text = _text(folder, cameras, topics, notes, tell)
    parse_rig(text, str(path))
    return text, tuple(notes)


def _cameras(folder: Path, notes: list[str]) -> list[tuple[ImageFolder, FolderPoses]]:
    """The folders of images that have poses, with these."""
    if not folder.is_dir():
        raise RigError(f"{folder}: there is no such folder")
    found = [camera for camera in read_folder(folder) if is_text(camera.path)]
    if not found:
        raise RigError(
            f"{folder}: no folder in it has two images or more that can be read (of depth images three, of 16 bits or "
            "of floating point); for trajectories alone (TUM, CSV) docs/odometry.md has a rig file"
        )
    with_poses = [(camera, camera.poses) for camera in found if camera.poses is not None]
    if not with_poses:
        named = some([f"{camera.path} ({len(camera.files)} images)" for camera in found], 5)
        raise RigError(
            f"{folder}: images in {named}, and no file of poses that fits them. Put the robot's pose at each image "
            "beside them, as poses.csv with a line an image: name, x, y, z, qx, qy, qz, qw (metres)"
        )
    notes += [f"not used: {camera.path}, no poses fit its images" for camera in found if camera.poses is None]
    for camera, poses in with_poses:
        notes.append(
            f"camera {camera.path}: {len(camera.files)} images of {camera.size[0]} x {camera.size[1]}, {poses.count} "
            f"with a pose in {poses.path}, intrinsics {camera.intrinsics or 'in no file'}"
        )
    return with_poses


def _text(
    folder: Path,
    cameras: Sequence[tuple[ImageFolder, FolderPoses]],
    topics: Sequence[ImageTopic],
    notes: list[str],
    tell: Progress,
) -> str:
    taken = {PARENT, CHILD}
    names = [free_name(camera_name(camera.path, ""), taken) for camera, _ in cameras]
    targets, remarks, of_targets = first_targets(topics, [], taken)
    notes += of_targets
    sensors: dict[str, Sensor] = {}
    stated: list[tuple[str, Camera]] = []
    for name, (camera, poses), topic in zip(names, cameras, topics, strict=True):
        if camera.camera is not None:
            section = Intrinsics(file=camera.intrinsics, camera=camera.camera_name or None, stated="nominal")
            remarks["sensors", name, "intrinsics"] = STATED
            stated.append((name, camera.camera))
        else:
            guess = guessed_intrinsics(camera.size, topic.boards)
            section, remarks["sensors", name, "intrinsics"] = guess.section, guess.words
            stated.append((name, guess.camera))
        time_offset, remarks["sensors", name, "time_offset"] = first_time_offset(_rest(poses))
        sensors[name] = Sensor(images=camera.path, poses=poses.path, intrinsics=section, time_offset=time_offset)
    tell("solving with the cameras on either carrier")
    views = _views(topics, stated, [section.target(name) for name, section in targets.items()])
    reading = best_reading(folder, cameras, views)
    notes.append(f"{reading.evidence.in_words(PARENT, CHILD)}: {ROLES[reading.evidence.role]}")
    take_sizes(targets, remarks, reading.evidence.sizes)
    carriers, remarks["carriers", "poses"] = _carriers(reading)
    origin = origin_of([part for _, poses in cameras for part in poses.path.split("/")])
    notes.append(f"poses: {origin.words}; their noise is left out, and residuals tell it")
    rig = Rig(carriers=carriers, sensors={**sensors}, targets={**targets})
    return first_rig_text("folder", folder.resolve().name, rig, remarks, "# Paths start from that folder.\n")


def _rest(poses: FolderPoses) -> Rest:
    """Whether the images were taken at rest."""
    stamps = poses.stamps_ns
    if stamps is None:
        return Rest(True, "images whose names are no stamps were taken at rest")
    of_poses = np.array(pose_stamps(poses.all) or (), dtype=np.int64)
    order = np.argsort(of_poses, kind="stable")
    order = order[np.append(np.diff(of_poses[order]) > 0, True)]
    return rest_of(stamps, Trajectory(of_poses[order], poses.all.T[order], poses.path))


def _views(topics: Sequence[ImageTopic], stated: Sequence[tuple[str, Camera]], targets: Sequence[Target]) -> list[View]:
    """The targets in the images that were searched."""
    by_name = {target.name: target for target in targets}
    views = []
    for number, (topic, (name, intrinsics)) in enumerate(zip(topics, stated, strict=True)):
        for place, found in zip(topic.places, Detector(intrinsics, targets)(topic.pictures), strict=True):
            views += [View(number, place, name, by_name[d.target], d) for d in found.detections]
    return views


def _carriers(reading: PoseReading) -> tuple[Carriers, str]:
    said, evidence = reading.stated, reading.evidence
    source = PoseSource(
        frames=(PARENT, CHILD), quaternion=said.quaternion, euler=said.euler, angles=said.angles, length=said.length
    )  # fmt: skip
    if evidence.role is None:
        remark = (
            "TODO the images cannot tell what carries the sensors: exchange the two names for cameras beside the robot "
            f"({evidence.in_words(PARENT, CHILD)})"
        )
    else:
        remark = (
            f"a guess, as is that the files have T_{PARENT}_{CHILD}: {evidence.in_words(PARENT, CHILD)}. If the files "
            f"have T_{CHILD}_{PARENT}, exchange the two frames here, and sensors and targets above"
        )
    if said.euler is not None and evidence.role is None:
        remark += f"; TODO the files have three angles, and {said.euler} in degrees is a guess"
    elif said.euler is not None:
        remark += f"; of the usual conventions of angles {said.euler} in {said.angles} explains the images best"
    elif reading.otherwise is not None:
        remark += f"; with quaternions as x, y, z, w {reading.otherwise.in_words(PARENT, CHILD)}"
    if said.length is not None:
        remark += "; positions are spread as millimetres are"
    sensors, targets = (PARENT, CHILD) if evidence.role == "parent" else (CHILD, PARENT)
    return Carriers(sensors=sensors, targets=targets, poses=source), remark


#: Conventions of three angles that arms' controllers and programs write, the commonest first.
AXES = ("ZYX", "xyz", "XYZ", "rotation_vector", "ZYZ", "zyx")
#: Poses are equal if their matrices differ by less than this.
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
    """How the poses are read."""

    stated: PoseStatement  #: What the rig file must say
    evidence: RoleEvidence  #: Evidence for this reading
    #: Evidence for the usual reading, if another reading explains the images far better
    otherwise: RoleEvidence | None


def best_reading(
    folder: Path, cameras: Sequence[tuple[ImageFolder, FolderPoses]], views: Sequence[View]
) -> PoseReading:
    """The reading of the poses that best explains the images; the usual one unless another is far better."""
    usual = [poses for _, poses in cameras]
    stated = usual[0].stated
    as_read = _evidence(usual, views)
    best, found = stated, as_read
    for other in _others(stated):
        read = [poses_read(folder, camera.files, folder / poses.path, other) for camera, poses in cameras]
        there = [poses for poses in read if poses is not None]
        if len(there) < len(read) or all(
            np.allclose(a.T, b.T, rtol=0.0, atol=SAME, equal_nan=True) for a, b in zip(there, usual, strict=True)
        ):
            continue
        evidence = _evidence(there, views)
        if evidence.explains_far_better(as_read) and (best is stated or evidence.product < found.product):
            best, found = other, evidence
    return PoseReading(best, found, None if best is stated else as_read)


def _others(stated: PoseStatement) -> Iterator[PoseStatement]:
    if stated.euler is None:
        yield replace(stated, quaternion="wxyz")
        return
    for axes in AXES:
        yield replace(stated, euler=axes, angles="degrees")
        yield replace(stated, euler=axes, angles="radians")


def _evidence(poses: Sequence[FolderPoses], views: Sequence[View]) -> RoleEvidence:
    return evidence_of_roles(
        Seen(view.sensor, view.target, view.detection, poses[view.camera].T[view.place]) for view in views
    )
