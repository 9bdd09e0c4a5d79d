"""The content of a folder, for a rig file: folders of images and of clouds, poses for them, and files of intrinsics.

Every file is identified by its content: a file of poses has poses that fit the images, a file of intrinsics has a
camera of the images' size.
"""

from __future__ import annotations

import math
import os
import warnings
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from gtsam_rwhec.cameras.camera import Camera
from gtsam_rwhec.cameras.intrinsics_files import read_cameras
from gtsam_rwhec.clouds.cloud import CLOUD_FORMATS, Cloud
from gtsam_rwhec.clouds.cloud_files import read_cloud
from gtsam_rwhec.detect.images import Gray, decode_gray, has_depths, stated_size
from gtsam_rwhec.errors import CameraError, CloudError, FileFormatError, ImageError, LogError
from gtsam_rwhec.files.terminal_text import natural_key
from gtsam_rwhec.files.whole_files import read_whole
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.logs import ImageRecord
from gtsam_rwhec.logs.image_folder import FORMATS, LARGEST_IMAGE, TABLES, image_stamps, match, pose_stamps, read_poses
from gtsam_rwhec.logs.pose_tables import NamedPoses, PoseStatement
from gtsam_rwhec.logs.pose_trees import TREES

#: Folders are searched to this depth.
DEPTH = 4
#: A folder of images has at least this number.
LEAST_IMAGES = 2
#: Endings of files that are clouds and nothing else, and of images that may be depths.
ENDINGS = tuple(ending for ending in CLOUD_FORMATS if ending not in FORMATS)
DEPTHS = tuple(ending for ending in CLOUD_FORMATS if ending in FORMATS)
#: A folder of clouds has at least this number.
LEAST_CLOUDS = 3
#: Clouds of which the median point is farther away than this many units are in millimetres.
FAR_UNITS = 50.0
#: Files of intrinsics have these endings.
INTRINSICS = (".yaml", ".yml", ".xml", ".json", ".txt")
#: A folder with more files than this is not tried as poses or intrinsics: its files are for single images.
MOST_TRIED = 12
#: Formats that a file of poses may leave open, in the order in which they are tried.
STATEMENTS = (
    PoseStatement(),
    PoseStatement(length="mm"),
    PoseStatement(euler="ZYX", angles="degrees"),
    PoseStatement(euler="ZYX", angles="degrees", length="mm"),
)


@dataclass(frozen=True, eq=False)
class FolderPoses:
    """The poses for a folder of images."""

    path: str  #: From the folder that was looked at
    stated: PoseStatement  #: What the file does not say, and reading needs: a guess
    T: Array  #: (n, 4, 4): The pose of each image; nan where there is none
    stamps_ns: np.ndarray | None  #: (n,): The images' stamps, if their names are stamps
    all: NamedPoses  #: All poses of the file

    @property
    def count(self) -> int:
        """The number of images with a pose."""
        return int(np.isfinite(self.T[:, 0, 0]).sum())


@dataclass(frozen=True, eq=False)
class ImageFolder:
    """A folder of images of one camera."""

    path: str  #: From the folder that was looked at; ``.`` for itself.
    files: tuple[Path, ...]  #: In natural order
    size: tuple[int, int]  #: (int, int): Width and height, pixels, of the first image that can be read
    poses: FolderPoses | None
    intrinsics: str  #: The file of intrinsics, from the folder that was looked at; empty if there is none
    camera_name: str  #: The camera's name in that file; empty where it has one alone
    camera: Camera | None  #: Its intrinsics


@dataclass(frozen=True)
class CloudFolder:
    """Clouds of one sensor."""

    path: str  #: Or pattern, from the folder that was looked at
    files: tuple[Path, ...]  #: In natural order
    unit_m: float | None  #: Metres of one unit, as far away as the points are; None: as such files have it
    size: tuple[int, int] | None = None  #: (int, int): Width and height of depth images, pixels
    intrinsics: str = ""  #: Of depth images, as those of an `ImageFolder`
    camera_name: str = ""
    camera: Camera | None = None


def is_folder_without_logs(path: Path) -> bool:
    """Whether a path is a folder without logs and without files of bags."""
    return path.is_dir() and not any(file.suffix.lower() in (".mcap", ".db3", ".bag") for file in path.iterdir())


def read_folder(folder: Path) -> list[ImageFolder]:
    """The folders of images in a folder, with their poses and intrinsics, in natural order."""
    found = []
    places = sorted(_image_folders(folder), key=lambda place: natural_key(str(place)))
    for place in places:
        files = sorted(_files(place, FORMATS), key=lambda file: natural_key(file.name))
        size = next((gray.shape[::-1] for file in files[:5] if (gray := read_gray(file)) is not None), None)
        if size is None:
            continue
        width, height = int(size[0]), int(size[1])
        intrinsics, name, camera = _intrinsics(folder, place, (width, height), places)
        poses = _poses(folder, place, files, places)
        found.append(
            ImageFolder(_inside(folder, place), tuple(files), (width, height), poses, intrinsics, name, camera)
        )
    return found


def read_gray(file: Path) -> Gray | None:
    """The pixels of an image; None if it cannot be read."""
    try:
        return decode_gray(_image(file))
    except (FileFormatError, ImageError):
        return None


def _image(file: Path) -> ImageRecord:
    data = read_whole(file, LARGEST_IMAGE, "An image was")
    return ImageRecord(0, 0, "", "", FORMATS[file.suffix.lower()], data, None, None, None)


def _depth_images(place: Path, names: Iterable[str]) -> tuple[list[str], str]:
    """Those of a folder's images that are depths, in natural order, and a pattern for them.

    Beside images in colour they are named so; their first image decides.
    """
    images = sorted((name for name in names if name.lower().endswith(DEPTHS)), key=natural_key)
    named = [name for name in images if "depth" in name.lower()]
    if not images:
        return [], ""
    first = Path((named or images)[0])
    alike = [name for name in named or images if Path(name).suffix == first.suffix]
    at = first.name.lower().find("depth")
    word = f"{first.name[at : at + len('depth')]}*" if named else ""
    try:
        is_depth = has_depths(_image(place / first), is_named=bool(named) or "depth" in place.name.lower())
    except FileFormatError:
        is_depth = False
    return (alike, f"*{word}{first.suffix}") if is_depth else ([], "")


def _image_folders(folder: Path) -> Iterator[Path]:
    for place, below, names in os.walk(folder):
        depth = len(Path(place).relative_to(folder).parts)
        below[:] = [] if depth >= DEPTH else [name for name in below if not name.startswith(".")]
        images = [name for name in names if Path(name).suffix.lower() in FORMATS]
        images = sorted(set(images) - set(_depth_images(Path(place), images)[0]))
        if len(images) >= LEAST_IMAGES and "depth" not in Path(place).name.lower():
            yield Path(place)


def _files(place: Path, endings: Iterable[str]) -> list[Path]:
    wanted = tuple(endings)
    return [file for file in place.iterdir() if file.suffix.lower() in wanted and file.is_file()]


def _inside(folder: Path, path: Path) -> str:
    return path.relative_to(folder).as_posix()


def _around(folder: Path, place: Path, image_folders: Iterable[Path]) -> Iterator[Path]:
    """Where to look for a folder of images, the nearest first: itself, the folders above it, and those beside them."""
    with_images = set(image_folders)
    yield place
    while place != folder:
        place = place.parent
        yield place
        beside = sorted((d for d in place.iterdir() if d.is_dir()), key=lambda d: natural_key(d.name))
        # A folder beside may have another camera's poses; the poses that fit best are taken.
        yield from (d for d in beside if d not in with_images and not d.name.startswith("."))


def _poses(folder: Path, place: Path, files: list[Path], image_folders: Iterable[Path]) -> FolderPoses | None:
    """The poses that fit the most images; of several, those in the nearest folder."""
    best: FolderPoses | None = None
    for near in _around(folder, place, image_folders):
        there = sorted(_files(near, (*TREES, *TABLES)), key=lambda file: natural_key(file.name))
        candidates = [near] if len(there) >= LEAST_IMAGES and near != folder else []
        if len(there) <= MOST_TRIED:
            candidates += there
        for candidate in candidates:
            read = (poses_read(folder, files, candidate, stated) for stated in STATEMENTS)
            fitting = next((poses for poses in read if poses is not None), None)
            if fitting is not None and (best is None or fitting.count > best.count):
                best = fitting
        if best is not None and best.count >= 0.8 * len(files):
            break  # what is further away belongs to another camera
    return best


def poses_read(folder: Path, files: Sequence[Path], path: Path, stated: PoseStatement) -> FolderPoses | None:
    """The poses of a file or a folder for the images, read as stated; None if they cannot be, or fit no images."""
    try:
        return _poses_for(folder, files, path, read_poses(path, stated), stated)
    except (LogError, FileFormatError):
        return None  # no file of poses, or one that needs another statement


def why_not_read(folder: Path, files: Sequence[Path], path: Path, statements: Iterable[PoseStatement]) -> str:
    """Why a file that has poses fits no images; empty if it has none under any statement."""
    for stated in statements:
        try:
            poses = read_poses(path, stated)
        except (LogError, FileFormatError):
            continue
        try:
            _poses_for(folder, files, path, poses, stated)
        except (LogError, FileFormatError) as error:
            return str(error)
    return ""


def _poses_for(
    folder: Path, files: Sequence[Path], path: Path, poses: NamedPoses, stated: PoseStatement
) -> FolderPoses | None:
    with warnings.catch_warnings(action="ignore"):  # of what is left over: calibration says it
        T = np.full((len(files), 4, 4), math.nan)
        stamps, of_poses = image_stamps(files), pose_stamps(poses)
        if stamps is not None and of_poses is not None:
            order = np.argsort(of_poses)
            at, wanted = np.array(of_poses)[order], np.array(stamps)
            near = np.clip(np.searchsorted(at, wanted), 1, len(at) - 1)
            near -= wanted - at[near - 1] < at[near] - wanted
            inside = (wanted >= at[0]) & (wanted <= at[-1])
            T[inside] = poses.T[order][near[inside]]
            return FolderPoses(_inside(folder, path), stated, T, wanted, poses) if inside.any() else None
        matched = match(files, poses, str(path))
        T[list(matched.images)] = poses.T[list(matched.poses)]
        return FolderPoses(_inside(folder, path), stated, T, None, poses)


def _intrinsics(
    folder: Path, place: Path, size: tuple[int, int], image_folders: Iterable[Path]
) -> tuple[str, str, Camera | None]:
    """The nearest file with a camera of this size: its path, the camera's name in it, and the camera."""
    words = set(place.relative_to(folder).parts)
    for near in _around(folder, place, image_folders):
        there = sorted(_files(near, INTRINSICS), key=lambda file: natural_key(file.name))
        # A file named like the camera's folder goes first.
        there.sort(key=lambda file: not any(word in file.stem for word in words))
        for file in there[:MOST_TRIED]:
            try:
                cameras = read_cameras(file, size)
            except (FileFormatError, CameraError):
                continue
            fitting = {name: camera for name, camera in cameras.items() if (camera.width, camera.height) == size}
            if fitting:
                name = next((name for name in fitting if name in words), next(iter(fitting)))
                return _inside(folder, file), name, fitting[name]
    return "", "", None


def cloud_folders(folder: Path) -> list[CloudFolder]:
    """The folders in a folder that have clouds, in natural order."""
    found = []
    for place, below, names in os.walk(folder):
        inside = Path(place).relative_to(folder)
        below[:] = [] if len(inside.parts) >= DEPTH else [name for name in below if not name.startswith(".")]
        by_pattern = {f"*{ending}": [name for name in names if name.lower().endswith(ending)] for ending in ENDINGS}
        depths, of_depths = _depth_images(Path(place), names)
        for pattern, alike in {**by_pattern, of_depths: depths}.items():
            files = tuple(Path(place) / name for name in sorted(alike, key=natural_key))
            several = any(Path(name).suffix.lower() in CLOUD_FORMATS for name in names if name not in alike)
            path = (inside / pattern if several else inside).as_posix()
            if len(files) < LEAST_CLOUDS:
                continue
            if pattern == of_depths:
                size = stated_size(_image(files[0]).data)
                assert size is not None
                intrinsics = _intrinsics(folder, Path(place), size, list(_image_folders(folder)))
                found.append(CloudFolder(path, files, None, size, *intrinsics))
            elif (cloud := next(filter(None, map(readable_cloud, files)), None)) is not None:
                is_far = float(np.median(np.linalg.norm(cloud.points, axis=1))) > FAR_UNITS
                found.append(CloudFolder(path, files, 1e-3 if is_far else None))
    return sorted(found, key=lambda each: natural_key(each.path))


def readable_cloud(file: Path, unit_m: float | None = None, camera: Camera | None = None) -> Cloud | None:
    """The cloud of a file, with points in metres; None if it cannot be read."""
    try:
        return read_cloud(file, unit_m=unit_m, camera=camera)
    except (CloudError, FileFormatError):
        return None
