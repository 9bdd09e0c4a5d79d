"""A log made of folders of images or clouds with poses beside them, as a rig file describes them.

The log has the images of each sensor on a topic that has the name of their path, and T_parent_child on ``/tf``; so the
same rig file serves for the folder and for the log. Clouds are points in their files' unit. There are two kinds of
folders:

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

from gtsam_rwhec.clouds.cloud import CLOUD_FORMATS, Cloud
from gtsam_rwhec.clouds.cloud_files import read_cloud
from gtsam_rwhec.clouds.named_fields import record_of_cloud
from gtsam_rwhec.errors import CloudError, FileFormatError, LogError, LogWarning, NotUniqueWarning
from gtsam_rwhec.files.progress import Counted, Progress, silent
from gtsam_rwhec.files.terminal_text import natural_key
from gtsam_rwhec.files.whole_files import checked_path, read_whole
from gtsam_rwhec.files.yaml_lines import KeyPath
from gtsam_rwhec.logs.hand_eye_samples import HandEyeSamples, is_samples_file, read_hand_eye_samples
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
from gtsam_rwhec.logs.pose_tables import NamedPoses, stem_of
from gtsam_rwhec.logs.records import Array, DetectionRecord
from gtsam_rwhec.problem.problem import Problem
from gtsam_rwhec.rig import Rig
from gtsam_rwhec.runs.run_log import IMAGES_METADATA, image_key
from gtsam_rwhec.solver.solution import solve

#: Nanoseconds between the stamps of images that were taken at rest: too far apart for poses to be interpolated.
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
    """Whether a path is a folder for a rig file with poses in files: with its images, or at least without a log."""
    if rig is None or rig.carriers.poses.frames is None or not isinstance(path, str | Path) or not Path(path).is_dir():
        return False
    folders = [of.images or of.clouds for of in rig.sensors.values()]
    has_images = any(each is not None and (Path(path) / each).is_dir() for each in folders)
    return has_images or not any(Path(path).glob("*.mcap"))


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
    """Write the images, or clouds, and poses of a folder as one log, for the same rig file.

    The paths of the rig file start from `folder`; the poses of its carriers are ``frames``, and its sensors have images
    or clouds, and poses. Returns how many images and clouds, and how many poses were written.

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
        topics = {name: str(sensor.images or sensor.clouds) for name, sensor in rig.sensors.items()}
        names = {
            image_key(topics[sensor], stamp): file.relative_to(folder).as_posix() for stamp, sensor, file in images
        }
        out.metadata(IMAGES_METADATA, names)
        for stamp, T in sorted(poses.items()):
            out.transforms("/tf", stamp, [(parent, child, T)])
        for done, (stamp, sensor, file) in enumerate(images, start=1):
            topic, frame = topics[sensor], rig.frame_of(sensor)
            if file.suffix.lower() in FORMATS:
                out.compressed_image(topic, stamp, frame, FORMATS[file.suffix.lower()], _content(file))
            else:
                out.point_cloud(record_of_cloud(_cloud(file), topic, stamp, frame))
            tell(Counted("reading images:" if rig.sensors[sensor].images else "reading clouds:", done, len(images)))
    return len(images), len(poses)


def _content(file: Path) -> bytes:
    """The bytes of an image; empty if the file cannot be read, so that only this image is lost."""
    try:
        return read_whole(file, LARGEST_IMAGE, "An image was")
    except FileFormatError as error:
        warnings.warn(f"{error} It counts as an image that cannot be used", LogWarning, stacklevel=3)
        return b""


def _cloud(file: Path) -> Cloud | None:
    """The cloud of a file, in the file's unit; None if it cannot be read, so that only this cloud is lost."""
    try:
        return read_cloud(file)
    except (FileFormatError, CloudError) as error:
        warnings.warn(f"{error}. It counts as a cloud that cannot be used", LogWarning, stacklevel=3)
        return None


@contextmanager
def _said_with(rig: Rig, path: KeyPath) -> Iterator[None]:
    """Add the rig file's line to an error of files that it names."""
    try:
        yield
    except LogError as error:
        raise type(error)(f"{error} ({rig.source.place(path)})") from error


def _stamped(folder: Path, rig: Rig) -> list[_Stamped]:
    stated = rig.carriers.poses.stated
    read: dict[Path, NamedPoses] = {}
    found: list[tuple[str, list[Path], NamedPoses]] = []
    for name, sensor in rig.sensors.items():
        key = "images" if sensor.images is not None else "clouds"
        place: str | None = getattr(sensor, key)
        if place is None:
            raise LogError(f"{rig.source.place(('sensors', name))}: a folder has images, and no topic of detections")
        if sensor.poses is None:
            raise LogError(
                f"{rig.source.place(('sensors', name))}: no poses. Name the file or the folder of the poses at which "
                f"the {key} were taken: poses: PATH"
            )
        with _said_with(rig, ("sensors", name, key)):
            files = images_in(checked_path(folder / place), FORMATS if key == "images" else CLOUD_FORMATS)
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


#: One setup explains the samples if its cost is this many times below the other's.
CLEARLY = 4.0
#: Names of the frames, which samples do not have.
BASE, HAND, CAMERA, TARGET = "base", "hand", "camera", "target"


@dataclass(frozen=True, eq=False)
class SamplesProblem:
    """The problem of a file of samples."""

    problem: Problem  #: A X = Y B of one camera and one target
    said: str  #: how the file was read, and why


def is_file_of_samples(path: object, rig: Rig | None) -> bool:
    """Whether a path is a file of samples for a rig file whose one sensor has detections."""
    return rig is not None and rig.carriers.poses.frames is not None and is_samples_file(path)


def samples_problem(path: str | Path) -> SamplesProblem:
    """The problem of a file of samples, without a rig file.

    The file may say whether the camera is on the hand or fixed. If it does not, both are solved, and the one that fits
    is taken.

    Raises
    ------
    LogError
        As `read_hand_eye_samples`; or neither setup fits clearly better than the other.
    """
    samples = read_hand_eye_samples(path)
    if samples.is_on_hand is not None:
        on_hand, why = samples.is_on_hand, "as the file says"
    elif samples.is_of_carriers:
        on_hand = True
        why = "which the file does not say: with a fixed camera the answer is the same, with base and hand exchanged"
    else:
        # whoever calibrates this problem says it again
        with warnings.catch_warnings(action="ignore", category=NotUniqueWarning):
            costs = {each: solve(_problem(samples, each)).certificate.cost for each in (True, False)}
        on_hand = costs[True] < costs[False]
        if max(costs.values()) < CLEARLY * min(costs.values()):
            raise LogError(
                f"{path}: a camera on the hand and a fixed one fit about equally well (costs {costs[True]:.3g} and "
                f"{costs[False]:.3g}). State which in a rig file (--rig): carriers: {{sensors: {HAND}, targets: "
                f"{BASE}, poses: {{frames: [{BASE}, {HAND}]}}}} with the camera on the hand"
            )
        why = f"which fits {max(costs.values()) / max(min(costs.values()), 1e-300):.3g} times better than the other"
    return SamplesProblem(_problem(samples, on_hand), f"{samples.reading(on_hand)}, {why}.")


def _problem(samples: HandEyeSamples, on_hand: bool) -> Problem:
    sensors, targets = (HAND, BASE) if on_hand else (BASE, HAND)
    problem = Problem(sensor_carrier=sensors, target_carrier=targets)
    problem.add(TARGET, CAMERA, samples.A(on_hand), samples.B, source=str(samples.path))
    return problem


def samples_of_rig(path: str | Path, rig: Rig) -> tuple[HandEyeSamples, bool]:
    """The samples of a file, and whether the rig file has the camera on the hand.

    Raises `LogError` as `read_hand_eye_samples`; or the rig file has more sensors or targets, or another setup.
    """
    parent, child = rig.carriers.poses.parent_and_child
    if len(rig.sensors) != 1 or len(rig.targets) != 1:
        raise LogError(
            f"{rig.source.place(('sensors',), ('targets',))}: {len(rig.sensors)} sensors and {len(rig.targets)} "
            f"targets; the samples in {path} are of one camera and one target"
        )
    ((name, sensor),) = rig.sensors.items()
    if sensor.detections is None:
        raise LogError(
            f"{rig.source.place(('sensors', name))}: the samples in {path} have no images. Write detections: /samples "
            "in place of images"
        )
    samples = read_hand_eye_samples(path, rig.carriers.poses.stated)
    on_hand = rig.carriers.sensors == child
    if samples.is_on_hand not in (None, on_hand) and samples.is_of_carriers:
        setup = "on the hand" if samples.is_on_hand else "fixed"
        raise LogError(
            f"{rig.source.place(('carriers',))}: {child}, which moves in {parent}, "
            f"{'carries' if on_hand else 'does not carry'} the sensors, and {path} is of a camera that is {setup}. "
            "Exchange sensors and targets of the carriers"
        )
    return samples, on_hand


def write_samples_log(path: str | Path, rig: Rig, out_path: str | Path) -> str:
    """Write samples as a log of the carriers' poses and the detections of the rig file's one sensor and target.

    The rig file's carriers have ``frames``: the file's robot poses are T_parent_child. Its sensor has ``detections``,
    the name of the topic to write. Returns how the file was read, in words. Raises as `samples_of_rig`.
    """
    samples, on_hand = samples_of_rig(path, rig)
    parent, child = rig.carriers.poses.parent_and_child
    ((name, sensor),) = rig.sensors.items()
    assert sensor.detections is not None
    T = samples.T_base_hand(on_hand)
    (target,) = rig.target_list
    with LogWriter(out_path) as out:
        for i, (robot, B) in enumerate(zip(T, samples.B, strict=True), start=1):
            stamp = APART_NS * i
            out.transforms("/tf", stamp, [(parent, child, robot)])
            frame = rig.frame_of(name)
            seen = DetectionRecord(stamp, stamp, sensor.detections, frame, target.family, target.name, T_camera_tag=B)
            out.detections(sensor.detections, stamp, frame, [seen])
    return samples.reading(on_hand)
