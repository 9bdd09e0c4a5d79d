"""Which pose belongs to which image of a folder, by name, by number or by stamp; the rest is counted and said."""

from __future__ import annotations

import re
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from gtsam_rwhec.errors import LogError, LogWarning
from gtsam_rwhec.files.natural_order import natural_key
from gtsam_rwhec.logs.image_folder import FORMATS
from gtsam_rwhec.logs.pose_rows import NamedPoses, stem_of
from gtsam_rwhec.logs.stamp_text import as_ns

#: A sentence names at most this many files.
MOST_NAMED = 5
#: Two poses are the same if their matrices differ by at most this.
SAME_POSE = 1e-9


@dataclass(frozen=True)
class Matched:
    """Images with their poses.

    Attributes
    ----------
    images : tuple of int
        Places of the images that have a pose.
    poses : tuple of int
        The pose of each.
    """

    images: tuple[int, ...]
    poses: tuple[int, ...]


def images_in(folder: Path) -> list[Path]:
    """The images of a folder in natural order; a LogError if it does not exist or has none.

    The last part of the path may be a pattern, ``rgb/*_color.png``, for folders that have other images too.
    """
    pattern = "*"
    if "*" in folder.name:
        folder, pattern = folder.parent, folder.name
    if not folder.is_dir():
        raise LogError(f"{folder}: there is no such folder of images{_folders_near(folder)}")
    files = sorted((f for f in folder.glob(pattern) if f.suffix.lower() in FORMATS), key=lambda f: natural_key(f.name))
    if not files:
        raise LogError(f"{folder / pattern if pattern != '*' else folder} has no images ({', '.join(FORMATS)})")
    return files


def _folders_near(folder: Path) -> str:
    """The folders with images beside one that is not there, in words."""
    above = next((each for each in (folder.parent, folder.parent.parent) if each.is_dir()), None)
    if above is None:
        return ""
    beside = sorted((each for each in above.iterdir() if each.is_dir()), key=lambda each: natural_key(each.name))
    names = [each.name for each in beside[:100] if any(file.suffix.lower() in FORMATS for file in each.glob("*"))]
    return f"; {above} has images in {_some(names)}" if names else ""


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

    Raises
    ------
    LogError
        Fewer than two images have a pose, an image has two different ones, or poses without names are more or fewer
        than the images.

    Warns
    -----
    LogWarning
        Some images have no pose, or the reverse.
    """
    for key in (stem_of, _number):
        of_images, of_poses = [key(file.name) for file in files], [key(name) for name in poses.names]
        if len(set(of_images)) < len(files) or not set(of_images) & set(of_poses) - {""}:
            continue
        found: dict[str, int] = {}
        for i, name in enumerate(of_poses):
            first = found.setdefault(name, i)
            if name in of_images and np.abs(poses.T[first] - poses.T[i]).max() > SAME_POSE:
                raise LogError(f"{where}: image {name} has two poses, {poses.places[first]} and {poses.places[i]}")
        images = tuple(i for i, name in enumerate(of_images) if name in found)
        matched = Matched(images, tuple(found[of_images[i]] for i in images))
        _say_the_rest(files, poses, matched, where, set(of_images), of_poses)
        return _enough(matched, files, poses, where)
    if any(poses.names) and pose_stamps(poses) is None and len(set(poses.names)) == len(poses.names) > 1:
        raise LogError(
            f"{where}: no pose has the name of an image. The first image is {files[0].name}, and the first pose is "
            f"{poses.names[0]!r} ({poses.places[0]}). Give both the same names or numbers"
        )
    if len(files) != len(poses.T):
        raise LogError(
            f"{where}: {len(files)} images and {len(poses.T)} poses without names of images ({poses.places[0]}): give "
            "one pose an image, or a first column with the images' names"
        )
    everyone = tuple(range(len(files)))
    return _enough(Matched(everyone, everyone), files, poses, where)


def _number(name: str) -> str:
    """The last number in a name, without zeros before it; empty without a number."""
    numbers = re.findall(r"\d+", stem_of(name))
    return numbers[-1].lstrip("0") or "0" if numbers else ""


def _enough(matched: Matched, files: Sequence[Path], poses: NamedPoses, where: str) -> Matched:
    if len(matched.images) < 2:
        raise LogError(
            f"{where}: {len(matched.images)} of {len(files)} images have one of the {len(poses.T)} poses; the first "
            f"image is {files[0].name}, and the first pose is {poses.names[0]!r}"
        )
    return matched


def _say_the_rest(
    files: Sequence[Path], poses: NamedPoses, matched: Matched, where: str, known: set[str], of_poses: list[str]
) -> None:
    has_pose = set(matched.images)
    alone = [file.name for i, file in enumerate(files) if i not in has_pose]
    idle = [poses.names[i] for i, name in enumerate(of_poses) if name not in known]
    said = [f"{len(alone)} of {len(files)} images have no pose ({_some(alone)})"] if alone else []
    said += [f"{len(idle)} of {len(poses.T)} poses have no image ({_some(idle)})"] if idle else []
    if said:
        warnings.warn(f"{where}: {', and '.join(said)}; they are left out", LogWarning, stacklevel=4)


def _some(names: Sequence[str]) -> str:
    return ", ".join(names[:MOST_NAMED]) + (", ..." if len(names) > MOST_NAMED else "")
