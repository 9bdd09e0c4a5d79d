"""All exported files of a calibration, written into one folder."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path

from gtsam_rwhec.errors import FileFormatError
from gtsam_rwhec.files.whole_files import write_atomically
from gtsam_rwhec.rig.exported_cameras import (
    FIRST_LINES,
    camchain_yaml,
    camera_info_yaml,
    colmap_cameras_txt,
    comment,
    opencv_yaml,
)
from gtsam_rwhec.rig.exported_poses import python_poses, static_tf_launch, tf_yaml, urdf_xacro
from gtsam_rwhec.rig.rig_frames import RigFrames

#: These functions give the text of each file, by its name.
FILES: dict[str, Callable[[RigFrames], str]] = {
    "static_tf.launch.py": static_tf_launch,
    "tf.yaml": tf_yaml,
    "rig.urdf.xacro": urdf_xacro,
    "camchain.yaml": camchain_yaml,
    "cameras.opencv.yaml": opencv_yaml,
    "cameras.txt": colmap_cameras_txt,
}
#: These functions give the texts with poses for people to copy, by the text's name.
COPIED: dict[str, Callable[[RigFrames], str]] = {
    "static_tf.launch.py": static_tf_launch,
    "rig.urdf.xacro": urdf_xacro,
    "tf.yaml": tf_yaml,
    "poses.py": python_poses,
}
#: These functions give the texts of a folder's files, by the files' names: one for each camera.
FOLDERS: dict[str, Callable[[RigFrames], dict[str, str]]] = {"camera_info": camera_info_yaml}
#: Files in these folders have this ending.
SUFFIX = ".yaml"


def export_all(frames: RigFrames, folder: str | Path) -> list[Path]:
    """Write the files of `FILES`, and ``camera_info/NAME.yaml`` for each camera.

    `folder` must exist; files of these names in it are replaced. Returns the written files.

    Raises
    ------
    FileFormatError
        A file cannot be written; the message says why.
    """
    # All texts come first: if one of them fails, no file is written.
    remarks = _remarks(frames)
    texts = {Path(folder) / name: _with_head(text(frames), remarks, name) for name, text in FILES.items()}
    of_cameras = {
        Path(folder) / inside / name: _with_head(text, remarks, name)
        for inside, made in FOLDERS.items()
        for name, text in made(frames).items()
    }
    for path, text in texts.items():
        write_atomically(path, text.encode())
    for path, text in of_cameras.items():
        try:
            path.parent.mkdir(exist_ok=True)
        except OSError as error:
            raise FileFormatError(f"{path.parent} cannot be made a folder: {error.strerror or error}.") from error
        write_atomically(path, text.encode())
    return [*texts, *of_cameras]


def copied_texts(frames: RigFrames) -> dict[str, str]:
    """The texts of `COPIED`, by name, with the warnings in the head of each."""
    return {name: _with_head(text(frames), _remarks(frames), name) for name, text in COPIED.items()}


def _remarks(frames: RigFrames) -> tuple[str, ...]:
    """The remarks at the head of every file."""
    return (*frames.warnings, *(f"Left out, because it has no answer: {why}" for why in frames.left_out.values()))


def _with_head(text: str, remarks: tuple[str, ...], name: str) -> str:
    """The text with remarks as comments at its beginning."""
    if not remarks:
        return text
    if name.endswith(".xacro"):
        declaration, rest = text.split("\n", 1)  # the first line of XML is its declaration
        joined = re.sub("-(?=-)", "- ", "\n".join(map(comment, remarks)))  # XML's comments hold no "--"
        return f"{declaration}\n<!--\n{joined}\n-->\n{rest}"
    before = FIRST_LINES if text.startswith(FIRST_LINES) else ""
    return before + "".join(f"# {comment(remark)}\n" for remark in remarks) + text.removeprefix(before)
