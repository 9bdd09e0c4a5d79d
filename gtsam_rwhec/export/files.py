"""All exported files of a calibration, written into one folder."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path

from gtsam_rwhec.export.camchain import camchain_yaml
from gtsam_rwhec.export.static_tf import static_tf_launch
from gtsam_rwhec.export.tf_tree import tf_yaml
from gtsam_rwhec.export.urdf import urdf_xacro
from gtsam_rwhec.files.atomic_write import write_atomically
from gtsam_rwhec.files.terminal_text import shown
from gtsam_rwhec.rig.calibrated_frames import RigFrames

#: A remark in a file has at most this many characters.
LONGEST_COMMENT = 2_000
#: These functions give the text of each file, by its name.
FILES: dict[str, Callable[[RigFrames], str]] = {
    "static_tf.launch.py": static_tf_launch,
    "tf.yaml": tf_yaml,
    "rig.urdf.xacro": urdf_xacro,
    "camchain.yaml": camchain_yaml,
}


def export_all(frames: RigFrames, folder: str | Path) -> list[Path]:
    """Write ``static_tf.launch.py``, ``tf.yaml``, ``rig.urdf.xacro`` and ``camchain.yaml``.

    Parameters
    ----------
    frames : RigFrames
    folder
        It must exist; files of these names in it are replaced.

    Returns
    -------
    list of Path
        The written files.

    Raises
    ------
    FileFormatError
        A file cannot be written; the message says why.
    """
    # All texts come first: if one of them fails, no file is written.
    remarks = (*frames.warnings, *(f"Left out, because it has no answer: {why}" for why in frames.left_out.values()))
    texts = {Path(folder) / name: _with_head(text(frames), remarks, name) for name, text in FILES.items()}
    for path, text in texts.items():
        write_atomically(path, text.encode())
    return list(texts)


def _with_head(text: str, remarks: tuple[str, ...], name: str) -> str:
    """The text with remarks as comments at its beginning."""
    if not remarks:
        return text
    if name.endswith(".xacro"):
        declaration, rest = text.split("\n", 1)  # the first line of XML is its declaration
        comment = re.sub("-(?=-)", "- ", "\n".join(map(_comment, remarks)))  # XML's comments hold no "--"
        return f"{declaration}\n<!--\n{comment}\n-->\n{rest}"
    return "".join(f"# {_comment(remark)}\n" for remark in remarks) + text


def _comment(remark: str) -> str:
    """A remark on one line: names in it come from a log, and a line break would end the comment."""
    return shown(remark, LONGEST_COMMENT)
