"""Logs made of a folder of images and a text file of poses, the form in which older tools take data.

The file is any that `read_poses` reads; names of columns, if it has them, go before the stated order. A pose's name is

- the file name of an image, with or without its ending: the image was taken at this pose. Images get stamps 1 s apart;
- or a stamp, in seconds (``1700000000.25``) or integer nanoseconds (16 digits or more). Then the images' file names are
  stamps too (``1700000000250000000.png``), and poses may come at another rate.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Literal

from gtsam_rwhec.errors import FileFormatError, LogError
from gtsam_rwhec.files.budgets import MESSAGE
from gtsam_rwhec.files.natural_order import natural_key
from gtsam_rwhec.files.paths import checked_path
from gtsam_rwhec.files.whole_files import read_whole
from gtsam_rwhec.logs.mcap_writer import LogWriter
from gtsam_rwhec.logs.pose_files import read_poses
from gtsam_rwhec.logs.pose_rows import PoseStatement
from gtsam_rwhec.logs.stamp_text import as_ns

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
    """Write images and poses as one log.

    Topics are ``/<camera>/image`` (``foxglove.CompressedImage``, the files' bytes as they are) and ``/tf``
    (``foxglove.FrameTransforms`` of T_parent_child).

    Parameters
    ----------
    images
        The folder; files with other endings than `FORMATS` are passed over.
    poses
        The file or folder of T_parent_child, in metres.
    path
        The MCAP file to write.
    columns
        The order of the seven numbers, where the file does not name them.
    parent, child, camera
        Names of the frames.

    Returns
    -------
    int, int
        How many images and how many poses were written.

    Raises
    ------
    LogError
        The folder has no images, a line is not a pose, or a name is neither an image nor a stamp. The message has the
        file and the line.
    """
    images, poses = checked_path(images), checked_path(poses)
    files = sorted((f for f in images.glob("*") if f.suffix.lower() in FORMATS), key=lambda f: natural_key(f.name))
    if not files:
        raise LogError(f"{images} has no images ({', '.join(FORMATS)}).")
    found = read_poses(poses, PoseStatement(length="m", columns=columns))
    names, T = list(found.names), found.T
    image_stamps, pose_stamps = _stamps(files, names, poses)
    entries = [(stamp, True, i) for i, stamp in enumerate(image_stamps)]
    entries += [(stamp, False, i) for i, stamp in enumerate(pose_stamps)]
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


def _stamps(files: Sequence[Path], names: Sequence[str], poses: Path) -> tuple[list[int], list[int]]:
    """The stamps of the images and the stamps of the poses."""
    known = {file.name: i for i, file in enumerate(files)} | {file.stem: i for i, file in enumerate(files)}
    if all(name in known for name in names):
        if len(set(names)) < len(names):
            raise LogError(f"{poses}: an image has two poses: {Counter(names).most_common(1)[0][0]}.")
        if all(as_ns(file.stem) is None for file in files):
            return [(i + 1) * 10**9 for i in range(len(files))], [(known[name] + 1) * 10**9 for name in names]
    image_stamps = [as_ns(file.stem) for file in files]
    pose_stamps = [as_ns(name.removesuffix(Path(name).suffix) if name in known else name) for name in names]
    for stamps, what in ((pose_stamps, names), (image_stamps, [file.name for file in files])):
        if None in stamps:
            raise LogError(
                f"{poses}: {what[stamps.index(None)]!r} is neither the name of an image nor a stamp in seconds or "
                f"nanoseconds; the first image is {files[0].name}, the first pose's name {names[0]!r}."
            )
    return [s for s in image_stamps if s is not None], [s for s in pose_stamps if s is not None]
