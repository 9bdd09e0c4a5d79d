"""What a stage takes over from the log before it, and where it may write: never onto a log that is the only one."""

from __future__ import annotations

import os
import re
from pathlib import Path

from gtsam_rwhec.errors import LogError
from gtsam_rwhec.logs import Log
from gtsam_rwhec.pipeline.log_metadata import CLEANING, DETECTION

#: Topics that the stages write, under any sensor's name; the solution's transforms are of no sensor.
DETECTED = re.compile(r"/calibration/.+/(detections|annotations|poses)")
PAIRED = re.compile(r"/calibration/(.+/pairs|tf_static)")


def topics_before_detection(log: Log) -> list[str]:
    """All topics but what stages wrote: detected anew, a log has only what is detected now."""
    written = (DETECTED, PAIRED) if {DETECTION, CLEANING} & set(log.metadata()) else ()
    return [topic.name for topic in log.topics() if not any(pattern.fullmatch(topic.name) for pattern in written)]


def topics_before_cleaning(log: Log) -> list[str]:
    """All topics but pairs and a solution, where there are any: a cleaned log can be cleaned anew."""
    return [topic.name for topic in log.topics() if not PAIRED.fullmatch(topic.name)]


def message_count(log: Log, topic: str) -> int:
    """How many messages of a topic there are, those that cannot be read too."""
    return sum(t.count for t in log.topics() if t.name == topic)


def check_writable(path: str | Path) -> None:
    """Refuse a file that could not be written, before work is put into what belongs there.

    Raises
    ------
    LogError
        There is no such folder, no right to write into it, or a folder of this name.
    """
    path = Path(path)
    folder = path.absolute().parent
    if not folder.is_dir():
        raise LogError(f"{path} cannot be written: there is no folder {folder}.")
    if path.is_dir():
        raise LogError(f"{path} cannot be written: it is a folder; give the name of a file.")
    if not os.access(folder, os.W_OK | os.X_OK):
        raise LogError(f"{path} cannot be written: no right to write into {folder}.")


def check_not_onto(log: Log, path: str | Path) -> None:
    """Refuse to write onto one of the files that a log is read from.

    Raises
    ------
    LogError
        It is one of them.
    """
    for file in log.files:
        if os.path.realpath(path) == os.path.realpath(file.path):
            raise LogError(f"{path} is the log that is read: a raw log stays as it is; give another file or folder.")
