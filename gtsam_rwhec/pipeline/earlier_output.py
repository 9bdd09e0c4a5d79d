"""Whether the files that a run would replace are its own earlier output: it refuses to replace any other file.

Pictures and files for other programs do not name the log that they are from. So the folder has a list of the files
that were written into it, with a checksum of each.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from pydantic import BaseModel, ConfigDict

from gtsam_rwhec.errors import LogError, RwhecError
from gtsam_rwhec.export.files import FILES
from gtsam_rwhec.files.atomic_write import write_atomically
from gtsam_rwhec.logs import open_log
from gtsam_rwhec.pipeline.log_contract import CLEAN_LOG, DETECTED_LOG, PLOTS_FOLDER, RESULT_FILE, SEEN_SHEET
from gtsam_rwhec.pipeline.log_metadata import read_metadata
from gtsam_rwhec.pipeline.output_paths import made_folder
from gtsam_rwhec.pipeline.solution_plots import COVERAGE, DEVIATIONS, FRAMES, RESIDUALS
from gtsam_rwhec.results.result_file import read_result

#: The list of the written files, in the output folder.
LIST_FILE = ".written.json"
#: Files that name the log that they are from.
_NAMING_THE_LOG = (RESULT_FILE, CLEAN_LOG, DETECTED_LOG)
#: All files that `calibrate_log` writes, relative to the output folder.
_WRITTEN = (
    *_NAMING_THE_LOG,
    *FILES,
    SEEN_SHEET,
    *(f"{PLOTS_FOLDER}/{name}" for name in (FRAMES, RESIDUALS, COVERAGE, DEVIATIONS)),
)


class _Written(BaseModel):
    """The list of the written files."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    log: str
    sha256: dict[str, str]


@contextmanager
def replacing_output(folder: Path, log_name: str) -> Iterator[None]:
    """Run `calibrate_log` in the block: it replaces its own earlier output in the folder, and no other file.

    Only the names of the files that `calibrate_log` writes count. Other files may be in the folder. The list of the
    written files is brought up to date at the end of the block, also if an error or the user ends it.

    Parameters
    ----------
    folder : Path
        It is made if it does not exist.
    log_name : str
        File name of the log whose earlier output may be replaced.

    Raises
    ------
    LogError
        A file that would be replaced is not known as an output of this log. Nothing was changed.
    """
    foreign = _foreign(folder, log_name)
    if foreign:
        raise LogError(
            f"{folder} has files that are not from an earlier run on {log_name}, or were changed since: "
            f"{', '.join(foreign)}. Give another folder, or remove them."
        )
    made_folder(folder)
    _write_list(folder, log_name)
    try:
        yield
    finally:
        _write_list(folder, log_name)


def _foreign(folder: Path, log_name: str) -> list[str]:
    """The names in the folder that would be replaced, and are not known as an output of the log."""
    # A link counts too if nothing is at its end: a file would be written there.
    there = [name for name in (*_WRITTEN, LIST_FILE) if os.path.lexists(folder / name)]
    if os.path.lexists(folder / PLOTS_FOLDER) and not (folder / PLOTS_FOLDER).is_dir():
        there.append(PLOTS_FOLDER)
    try:
        written = _Written.model_validate_json((folder / LIST_FILE).read_bytes())
    except (OSError, ValueError):
        return there
    if written.log != log_name:
        return there
    return [name for name in there if name != LIST_FILE and not _is_own(folder, name, written)]


def _is_own(folder: Path, name: str, written: _Written) -> bool:
    """Whether a file is as it was written, or names the log: a run that was killed had no time to list it."""
    path = folder / name
    if not path.is_file():
        return False
    if written.sha256.get(name) == _sha256(path):
        return True
    return name in _NAMING_THE_LOG and _sources(path) == (written.log,)


def _write_list(folder: Path, log_name: str) -> None:
    sums = {name: _sha256(folder / name) for name in _WRITTEN if (folder / name).is_file()}
    content = _Written(log=log_name, sha256=sums).model_dump_json(indent=2)
    write_atomically(folder / LIST_FILE, content.encode())


def _sha256(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()


def _sources(path: Path) -> tuple[str, ...]:
    """The names of the logs that a result or a stage's log was made from; empty for any other file."""
    try:
        if path.name == RESULT_FILE:
            log = read_result(path).log
            return () if log is None else log.detection.sources
        with open_log(path) as opened:
            return read_metadata(opened).detection.sources
    except RwhecError:
        return ()
