"""Folders of images with poses beside them: which pose belongs to which image, and the log that both make.

Poses are in one file for all images, in a folder with one file an image, or in an index. Where the names of images and
poses are stamps (seconds with a decimal point, or nanoseconds of 16 digits or more), the log has them, and poses may
come at another rate. Other images were taken at rest, and have the pose of their name, of its number, or of their
order.
"""

from __future__ import annotations

import re
import warnings
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from decimal import Decimal
from pathlib import Path
from typing import Literal

import numpy as np

from gtsam_rwhec.errors import FileFormatError, LogError, LogWarning
from gtsam_rwhec.files.budgets import MESSAGE
from gtsam_rwhec.files.terminal_text import natural_key, some
from gtsam_rwhec.files.whole_files import checked_path, read_whole
from gtsam_rwhec.logs.mcap_writer import LogWriter
from gtsam_rwhec.logs.pose_tables import (
    NamedPoses,
    PoseRow,
    PoseStatement,
    pose_text,
    poses_of,
    read_pose_table,
    stem_of,
)
from gtsam_rwhec.logs.pose_trees import TREES, PoseReference, read_pose_tree

Columns = Literal["tx ty tz qx qy qz qw", "tx ty tz qw qx qy qz", "qw qx qy qz tx ty tz", "qx qy qz qw tx ty tz"]
#: Foxglove gives the formats of images these names; the keys are the files' endings.
FORMATS = {
    ".png": "png", ".jpg": "jpeg", ".jpeg": "jpeg", ".webp": "webp", ".bmp": "bmp", ".tif": "tiff", ".tiff": "tiff",
}  # fmt: skip
#: Bytes of the largest file that is taken as an image. A log keeps images as they are.
LARGEST_IMAGE = MESSAGE


def is_image_folder(path: str | Path) -> bool:
    """Whether a folder has images and no file of a bag."""
    names = [file.suffix.lower() for file in checked_path(path).glob("*")]
    return any(suffix in FORMATS for suffix in names) and not {".db3", ".bag", ".mcap"} & set(names)


def write_image_folder(
    images: str | Path,
    poses: str | Path,
    path: str | Path,
    *,
    columns: Columns = "tx ty tz qx qy qz qw",
    parent: str = "base",
    child: str = "hand",
    camera: str = "camera",
) -> tuple[int, int]:
    """Write a folder of images, and a file or folder of their poses T_parent_child (metres), as one log.

    Topics are ``/<camera>/image`` (``foxglove.CompressedImage``, the files' bytes as they are) and ``/tf``
    (``foxglove.FrameTransforms``). Files with other endings than `FORMATS` are passed over; `columns` is the order of
    the seven numbers where the file of poses does not name them. Returns how many images and poses were written.

    Raises
    ------
    LogError
        The folder has no images, a line is not a pose, or a name is neither an image nor a stamp. The message has the
        file and the line.
    """
    files, poses = images_in(checked_path(images)), checked_path(poses)
    found = read_poses(poses, PoseStatement(length="m", columns=columns))
    of_images, of_poses = image_stamps(files), pose_stamps(found)
    T = found.T
    if of_images is None or of_poses is None:  # taken at rest: 1 s apart
        matched = match(files, found, str(poses))
        of_images, of_poses = ([(i + 1) * 10**9 for i in which] for which in (range(len(files)), matched.images))
        T = T[list(matched.poses)]
    entries = [(stamp, True, i) for i, stamp in enumerate(of_images)]
    entries += [(stamp, False, i) for i, stamp in enumerate(of_poses)]
    with LogWriter(path) as out:
        for stamp, is_image, i in sorted(entries):
            if not is_image:
                out.transforms("/tf", stamp, [(parent, child, T[i])])
                continue
            try:
                data = read_whole(files[i], LARGEST_IMAGE, "An image was")
            except FileFormatError as error:
                raise LogError(str(error)) from error
            out.compressed_image(f"/{camera}/image", stamp, camera, FORMATS[files[i].suffix.lower()], data)
    return len(files), len(T)


#: A stamp in nanoseconds has at least this many digits.
NANOSECOND_DIGITS = 16


def as_ns(text: str) -> int | None:
    """Exact nanoseconds of a stamp in seconds (with a decimal point or an exponent) or nanoseconds; else None."""
    if re.fullmatch(rf"\d{{{NANOSECOND_DIGITS},19}}", text, flags=re.ASCII):
        stamp = int(text)
    elif re.fullmatch(r"\d{1,10}\.\d{1,15}|\d\.\d{1,20}[eE][+-]?0?\d", text, flags=re.ASCII):
        stamp = int((Decimal(text) * 10**9).to_integral_value())
    else:
        return None
    return stamp if stamp < 1 << 63 else None


#: A sentence names at most this many files.
MOST_NAMED = 5
#: Two poses are the same if their matrices differ by at most this.
SAME_POSE = 1e-9


@dataclass(frozen=True)
class Matched:
    """Images with their poses."""

    images: tuple[int, ...]  #: Places of the images that have a pose
    poses: tuple[int, ...]  #: The pose of each


def images_in(folder: Path, endings: Iterable[str] = tuple(FORMATS)) -> list[Path]:
    """The images, or clouds, of a folder in natural order; a LogError if it does not exist or has none.

    The last part of the path may be a pattern, ``rgb/*_color.png``, for folders that have other images too.
    """
    pattern = "*"
    if "*" in folder.name:
        folder, pattern = folder.parent, folder.name
    if not folder.is_dir():
        raise LogError(f"{folder}: there is no such folder of images{_folders_near(folder)}")
    files = sorted((f for f in folder.glob(pattern) if f.suffix.lower() in endings), key=lambda f: natural_key(f.name))
    if not files:
        what = "images" if set(endings) == set(FORMATS) else "clouds"
        raise LogError(f"{folder / pattern if pattern != '*' else folder} has no {what} ({', '.join(endings)})")
    return files


def _folders_near(folder: Path) -> str:
    """The folders with images beside one that is not there, in words."""
    above = next((each for each in (folder.parent, folder.parent.parent) if each.is_dir()), None)
    if above is None:
        return ""
    beside = sorted((each for each in above.iterdir() if each.is_dir()), key=lambda each: natural_key(each.name))
    names = [each.name for each in beside[:100] if any(file.suffix.lower() in FORMATS for file in each.glob("*"))]
    return f"; {above} has images in {some(names, MOST_NAMED)}" if names else ""


def image_stamps(files: Sequence[Path]) -> list[int] | None:
    """The stamps that the images' names are, nanoseconds; None if a name is no stamp: they were taken at rest.

    All names may have words before the stamp, as ``frame_1700000000.25.png``.
    """
    stamps = [as_ns(re.sub(r"^([A-Za-z]+[0-9]{0,2}[_-]+)+", "", file.stem)) for file in files]
    known = [stamp for stamp in stamps if stamp is not None]
    return known if len(known) == len(files) else None


def pose_stamps(poses: NamedPoses) -> list[int] | None:
    """The stamps that the poses' names are, nanoseconds; None if a name is no stamp."""
    stamps = [as_ns(stem_of(name) if as_ns(stem_of(name)) is not None else name) for name in poses.names]
    known = [stamp for stamp in stamps if stamp is not None]
    return known if len(known) == len(poses.names) else None


def match(files: Sequence[Path], poses: NamedPoses, where: str) -> Matched:
    """Match images and poses by name, else by the number in the name; poses without names by their order.

    Warns of images without a pose, and the reverse.

    Raises
    ------
    LogError
        Fewer than two images have a pose, an image has two different ones, or poses without names are more or fewer
        than the images.
    """
    for key in (stem_of, _number):
        of_images, of_poses = [key(file.name) for file in files], [key(name) for name in poses.names]
        if len(set(of_images)) < len(files) or not set(of_images) & set(of_poses) - {""}:
            continue
        found: dict[str, int] = {}
        for i, name in enumerate(of_poses):
            first = found.setdefault(name, i)
            if name in of_images and np.abs(poses.T[first] - poses.T[i]).max() > SAME_POSE:
                raise LogError(
                    f"{where}: {_word(files)} {name} has two poses, {poses.places[first]} and {poses.places[i]}"
                )
        images = tuple(i for i, name in enumerate(of_images) if name in found)
        matched = Matched(images, tuple(found[of_images[i]] for i in images))
        _say_the_rest(files, poses, matched, where, set(of_images), of_poses)
        return _enough(matched, files, poses, where)
    if any(poses.names) and pose_stamps(poses) is None and len(set(poses.names)) == len(poses.names) > 1:
        raise LogError(
            f"{where}: no pose has the name of {_a(files)}. The first {_word(files)} is {files[0].name}, and the first "
            f"pose is {poses.names[0]!r} ({poses.places[0]}). Give both the same names or numbers"
        )
    if len(files) != len(poses.T):
        raise LogError(
            f"{where}: {len(files)} {_word(files)}s and {len(poses.T)} poses without names of these "
            f"({poses.places[0]}): give one pose each, or a first column with the names"
        )
    everyone = tuple(range(len(files)))
    return _enough(Matched(everyone, everyone), files, poses, where)


def _word(files: Sequence[Path]) -> str:
    return _a(files).partition(" ")[2]


def _a(files: Sequence[Path]) -> str:
    return "an image" if files[0].suffix.lower() in FORMATS else "a cloud"


def _number(name: str) -> str:
    """The last number in a name, without zeros before it; empty without a number."""
    numbers = re.findall(r"\d+", stem_of(name))
    return numbers[-1].lstrip("0") or "0" if numbers else ""


def _enough(matched: Matched, files: Sequence[Path], poses: NamedPoses, where: str) -> Matched:
    if len(files) < 2:
        raise LogError(
            f"{where}: there is one {_word(files)}, {files[0].name}; a calibration needs three poses and more that "
            "turn about two axes: take more"
        )
    if len(matched.images) < 2:
        raise LogError(
            f"{where}: {len(matched.images)} of {len(files)} {_word(files)}s have one of the {len(poses.T)} poses; the "
            f"first is {files[0].name}, and the first pose is {poses.names[0]!r}"
        )
    return matched


def _say_the_rest(
    files: Sequence[Path], poses: NamedPoses, matched: Matched, where: str, known: set[str], of_poses: list[str]
) -> None:
    has_pose = set(matched.images)
    alone = [file.name for i, file in enumerate(files) if i not in has_pose]
    idle = [poses.names[i] for i, name in enumerate(of_poses) if name not in known]
    said = [f"{len(alone)} of {len(files)} {_word(files)}s have no pose ({some(alone, MOST_NAMED)})"] if alone else []
    said += [f"{len(idle)} of {len(poses.T)} poses have no {_word(files)} ({some(idle, MOST_NAMED)})"] if idle else []
    if said:
        warnings.warn(f"{where}: {', and '.join(said)}; they are left out", LogWarning, stacklevel=4)


#: Files of tables of poses.
TABLES = (".csv", ".txt", ".tum", ".dat", ".tsv", ".asc")


def read_poses(path: str | Path, stated: PoseStatement | None = None) -> NamedPoses:
    """Read the poses of a file, or of a folder with one pose a file, whose names poses without a name then have.

    `stated` is what the files do not say. Raises `LogError` if there are no poses, or one cannot be read, with the file
    and the line.
    """
    path, stated = checked_path(path), stated or PoseStatement()
    if not path.is_dir():
        return poses_of(_file(path, stated), stated)
    files = sorted((f for f in path.iterdir() if f.suffix.lower() in TREES + TABLES), key=lambda f: natural_key(f.name))
    if not files:
        raise LogError(f"{path} has no files of poses ({', '.join(TREES + TABLES)})")
    files = _of_one_kind(path, files)
    if len(files) == 1:
        return poses_of(_file(files[0], stated), stated)
    rows = []
    for file in files:
        of_file = _file(file, stated)
        if len(of_file) > 1:
            raise LogError(
                f"{file} has {len(of_file)} poses, and the folder {path} has {len(files)} files: give one pose a file, "
                "or name the one file that has them all"
            )
        rows.append(replace(of_file[0], name=file.name))
    return poses_of(rows, stated)


def _of_one_kind(folder: Path, files: list[Path]) -> list[Path]:
    """The files with the ending that most have; the others are said, as a LICENSE.txt beside the poses."""
    ending, _ = Counter(file.suffix.lower() for file in files).most_common(1)[0]
    others = [file.name for file in files if file.suffix.lower() != ending]
    if others:
        count = len(files) - len(others)
        words = f"{folder}: poses are read from the {count} files {ending}, and not from {some(others, MOST_NAMED)}"
        warnings.warn(words, LogWarning, stacklevel=4)
    return [file for file in files if file.suffix.lower() == ending]


def _file(path: Path, stated: PoseStatement) -> list[PoseRow]:
    """The rows of one file."""
    if path.suffix.lower() not in TREES:
        return read_pose_table(str(path), pose_text(path), stated=stated)
    entries = read_pose_tree(str(path), pose_text(path))
    referred = [_referred(path, entry, stated) for entry in entries if isinstance(entry, PoseReference)]
    # Other poses of an index are first guesses of the calibration.
    return referred or [entry for entry in entries if isinstance(entry, PoseRow)]


def _referred(index: Path, entry: PoseReference, stated: PoseStatement) -> PoseRow:
    """The pose in the file that an index names for an image."""
    file = checked_path(index.parent / entry.file)
    if not file.is_file():
        raise LogError(f"{entry.place}: there is no file {file}")
    if file.suffix.lower() in TREES:
        found = [row for row in read_pose_tree(str(file), pose_text(file)) if isinstance(row, PoseRow)]
    else:
        found = read_pose_table(str(file), pose_text(file), stated=stated)
    if len(found) != 1:
        raise LogError(f"{file} has {len(found)} poses in place of one ({entry.place} names it)")
    return replace(found[0], name=entry.name)
