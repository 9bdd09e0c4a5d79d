"""What an image of a log is called: the name of the file that it was, or its stamp."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import PurePosixPath

from gtsam_rwhec.logs import Log
from gtsam_rwhec.runs.log_contract import IMAGES_METADATA, image_key

#: A part of a file's name has at most this many characters.
LONGEST = 80


def image_names(log: Log) -> Mapping[str, str]:
    """The names of the files that a folder's images were, by `image_key`; empty for other logs."""
    return log.metadata().get(IMAGES_METADATA, {})


def image_name(names: Mapping[str, str], topic: str, stamp_ns: int) -> str:
    """The name of the file that an image was, from its folder; else its stamp in nanoseconds."""
    return names.get(image_key(topic, stamp_ns), str(stamp_ns))


def picture_file(sensor: str, name: str) -> str:
    """The file name of an image's picture: its sensor and its own name, whatever characters strangers gave them."""
    stem = PurePosixPath(name).stem or name
    return f"{_plain(sensor)}_{_plain(stem)}.png"


def _plain(name: str) -> str:
    return re.sub(r"[^\w.-]+", "_", name)[:LONGEST].strip(".") or "_"
