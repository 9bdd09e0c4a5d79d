"""Poses beside images: one file for all (CSV, TUM, JSON, YAML), a folder with one file an image, or an index."""

from __future__ import annotations

import warnings
from collections import Counter
from dataclasses import replace
from pathlib import Path

from gtsam_rwhec.errors import LogError, LogWarning
from gtsam_rwhec.files.natural_order import natural_key
from gtsam_rwhec.files.paths import checked_path
from gtsam_rwhec.logs.pose_rows import NamedPoses, PoseRow, PoseStatement, poses_of
from gtsam_rwhec.logs.pose_tables import pose_text, read_pose_table
from gtsam_rwhec.logs.pose_trees import PoseReference, read_pose_tree

#: Files of trees, and files of tables.
TREES, TABLES = (".json", ".yaml", ".yml", ".xml", ".samples"), (".csv", ".txt", ".tum", ".dat", ".tsv", ".asc")


def read_poses(path: str | Path, stated: PoseStatement | None = None) -> NamedPoses:
    """Read poses.

    Parameters
    ----------
    path
        A file, or a folder with one pose a file; a pose without a name of its own then has its file's.
    stated : PoseStatement, optional
        What the files do not say.

    Raises
    ------
    LogError
        There are no poses, or one cannot be read; the message has the file and the line.
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
        names = ", ".join(others[:5]) + (", ..." if len(others) > 5 else "")
        words = f"{folder}: poses are read from the {len(files) - len(others)} files {ending}, and not from {names}"
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
