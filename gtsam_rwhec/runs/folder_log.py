"""A log made of folders of images with poses beside them, as a rig file describes them.

The log has the images of each sensor on a topic that has the name of their path, and T_parent_child on ``/tf``; so the
same rig file serves for the folder and for the log. There are two kinds of folders:

- The images' names are stamps. Poses come at these stamps or at another rate, and are interpolated.
- Any other names: the robot stood still for each image. Each image gets a stamp of its own, a second after the one
  before, and its pose has the same stamp. Images of different cameras never share a stamp, whatever their numbers,
  unless the rig file says ``one_instant: true``: then images of one name are of one instant.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from gtsam_rwhec.errors import FileFormatError, LogError, LogWarning
from gtsam_rwhec.files.progress import Counted, Progress, silent
from gtsam_rwhec.files.terminal_text import natural_key
from gtsam_rwhec.files.whole_files import checked_path, read_whole
from gtsam_rwhec.files.yaml_lines import KeyPath
from gtsam_rwhec.logs.hand_eye_samples import is_samples_file
from gtsam_rwhec.logs.image_folder import (
    FORMATS,
    LARGEST_IMAGE,
    SAME_POSE,
    image_stamps,
    images_in,
    match,
    pose_stamps,
    read_poses,
)
from gtsam_rwhec.logs.mcap_writer import LogWriter
from gtsam_rwhec.logs.pose_rows import NamedPoses, PoseStatement, stem_of
from gtsam_rwhec.logs.records import Array
from gtsam_rwhec.rig import Rig
from gtsam_rwhec.runs.log_contract import IMAGES_METADATA, image_key

#: Images that were taken at rest have stamps this far apart, nanoseconds: further than poses are interpolated.
APART_NS = 10**9
#: The first stamp of images that were taken at rest.
FIRST_NS = 10**9


@dataclass(frozen=True, eq=False)
class _Stamped:
    """A sensor's images and poses with their stamps, nanoseconds."""

    sensor: str
    files: Sequence[Path]
    image_ns: Sequence[int]
    pose_ns: Sequence[int]
    T: Array
    places: Sequence[str]


def is_folder_of_images(path: object, rig: Rig | None) -> bool:
    """Whether a path is a folder, without a log in it, for a rig file with poses in files."""
    if rig is None or not isinstance(path, str | Path) or not Path(path).is_dir():
        return False
    return rig.carriers.poses.frames is not None and not any(Path(path).glob("*.mcap"))


def check_is_no_other_folder(path: object, rig: Rig | None) -> None:
    """Refuse a folder without a log, and samples, with a rig file of a log; a `LogError` says what to write."""
    if rig is not None and rig.carriers.poses.frames is None and is_samples_file(path):
        parent, child = rig.carriers.poses.parent_and_child
        raise LogError(
            f"{path} is no log, and {rig.source.place(('carriers', 'poses'))} is of a log. For samples of a hand-eye "
            f"tool write poses: {{frames: [{parent}, {child}]}}, and detections: /samples for the one sensor"
        )
    if rig is None or not isinstance(path, str | Path) or not Path(path).is_dir() or is_folder_of_images(path, rig):
        return
    if not any(Path(path).glob("*.mcap")):
        if any(Path(path).glob("*.db3")):
            raise LogError(
                f"{path} is a ROS 2 bag of db3 files; convert it first: gtsam-rwhec convert {path} -o run.mcap"
            )
        parent, child = rig.carriers.poses.parent_and_child
        raise LogError(
            f"{path} is a folder without MCAP files, and {rig.source.place(('carriers', 'poses'))} is of a log. For "
            f"images with poses beside them write poses: {{frames: [{parent}, {child}]}}, and for each sensor "
            "images: PATH and poses: PATH, which start from the folder"
        )


def write_folder_log(
    folder: str | Path, rig: Rig, path: str | Path, *, progress: Progress | None = None
) -> tuple[int, int]:
    """Write the images and poses of a folder as one log, for the same rig file.

    Parameters
    ----------
    folder
        Where the paths of the rig file start.
    rig : Rig
        The poses of its carriers are ``frames``, and its sensors have images and poses.
    path
        The MCAP file to write.
    progress : callable, optional

    Returns
    -------
    int, int
        How many images and how many poses were written.

    Raises
    ------
    LogError
        A folder or file is missing or cannot be read, images and poses do not fit, or one stamp has two poses; the
        message has the files.

    Warns
    -----
    LogWarning
        Images without a pose, or poses without an image, are left out; or a file of an image cannot be read.
    """
    folder, tell = checked_path(folder), progress or silent
    tell(f"reading {folder}")
    stamped = _stamped(folder, rig)
    poses = _poses_by_stamp(stamped)
    parent, child = rig.carriers.poses.parent_and_child
    images = sorted(
        (stamp, each.sensor, file) for each in stamped for stamp, file in zip(each.image_ns, each.files, strict=True)
    )
    with LogWriter(path) as out:
        names = {
            image_key(str(rig.sensors[sensor].images), stamp): f"{rig.sensors[sensor].images}/{file.name}"
            for stamp, sensor, file in images
        }
        out.metadata(IMAGES_METADATA, names)
        for stamp, T in sorted(poses.items()):
            out.transforms("/tf", stamp, [(parent, child, T)])
        for done, (stamp, sensor, file) in enumerate(images, start=1):
            topic = rig.sensors[sensor].images
            assert topic is not None
            out.compressed_image(topic, stamp, rig.frame_of(sensor), FORMATS[file.suffix.lower()], _content(file))
            tell(Counted("reading images:", done, len(images)))
    return len(images), len(poses)


def _content(file: Path) -> bytes:
    """The bytes of an image; none of a file that cannot be read, which costs this image and no other."""
    try:
        return read_whole(file, LARGEST_IMAGE, "An image was")
    except FileFormatError as error:
        warnings.warn(f"{error} It counts as an image that cannot be used", LogWarning, stacklevel=3)
        return b""


@contextmanager
def _said_with(rig: Rig, path: KeyPath) -> Iterator[None]:
    """Add the rig file's line to an error of files that it names."""
    try:
        yield
    except LogError as error:
        raise type(error)(f"{error} ({rig.source.place(path)})") from error


def _stamped(folder: Path, rig: Rig) -> list[_Stamped]:
    source = rig.carriers.poses
    stated = PoseStatement(source.quaternion, source.euler, source.angles, source.length)
    read: dict[Path, NamedPoses] = {}
    found: list[tuple[str, list[Path], NamedPoses]] = []
    for name, sensor in rig.sensors.items():
        if sensor.images is None:
            raise LogError(f"{rig.source.place(('sensors', name))}: a folder has images, and no topic of detections")
        if sensor.poses is None:
            raise LogError(
                f"{rig.source.place(('sensors', name))}: no poses. Name the file or the folder of the poses at which "
                "the images were taken: poses: PATH"
            )
        with _said_with(rig, ("sensors", name, "images")):
            files = images_in(checked_path(folder / sensor.images))
        where = checked_path(folder / sensor.poses)
        if where not in read:
            with _said_with(rig, ("sensors", name, "poses")):
                read[where] = read_poses(where, stated)
        found.append((name, files, read[where]))
    of_images = [image_stamps(files) for _, files, _ in found]
    of_poses = [pose_stamps(poses) for _, _, poses in found]
    if all(stamps is not None for stamps in of_images + of_poses):
        return [
            _Stamped(name, files, image_ns or (), pose_ns or (), poses.T, poses.places)
            for (name, files, poses), image_ns, pose_ns in zip(found, of_images, of_poses, strict=True)
        ]
    return _at_rest(folder, rig, found)


def _at_rest(folder: Path, rig: Rig, found: list[tuple[str, list[Path], NamedPoses]]) -> list[_Stamped]:
    """Images that were taken at rest, each at the stamp of its own pose."""
    for name, sensor in rig.sensors.items():
        if sensor.time_offset == "estimate":
            raise LogError(
                f"{rig.source.place(('sensors', name, 'time_offset'))}: the images of {sensor.images} have "
                "no stamps, so no clock can be estimated. Leave time_offset out"
            )
    names = sorted({stem_of(file.name) for _, files, _ in found for file in files}, key=natural_key)
    instant = {name: FIRST_NS + APART_NS * i for i, name in enumerate(names)}
    result, begin = [], FIRST_NS
    for name, files, poses in found:
        matched = match(files, poses, f"{folder}, {name}")
        own = [files[i] for i in matched.images]
        if rig.carriers.poses.one_instant:
            stamps = [instant[stem_of(file.name)] for file in own]
        else:
            stamps = [begin + APART_NS * i for i in range(len(own))]
            begin += APART_NS * len(own)
        at = list(matched.poses)
        result.append(_Stamped(name, own, stamps, stamps, poses.T[at], [poses.places[i] for i in at]))
    return result


def _poses_by_stamp(stamped: list[_Stamped]) -> dict[int, Array]:
    """The poses of all sensors; one stamp has one pose."""
    poses: dict[int, tuple[Array, str]] = {}
    for each in stamped:
        for stamp, T, place in zip(each.pose_ns, each.T, each.places, strict=True):
            first, where = poses.setdefault(stamp, (T, place))
            if np.abs(first - T).max() > SAME_POSE:
                raise LogError(
                    f"{where} and {place} are two poses of the same frame at one stamp, {stamp} ns: "
                    f"{first[:3, 3].tolist()} and {T[:3, 3].tolist()} m. One of them is of another time or frame"
                )
    return {stamp: T for stamp, (T, _) in poses.items()}
